"""Links of submissions: which ones the page and the table may show."""

import re
from urllib.parse import urlsplit

LINK = re.compile(r"https?://[A-Za-z0-9\-._~:/?#!$&'*+,;=%]+")
"""A web address without a user name, and without the characters that end a link in Markdown; the rest is percent-encoded."""


def is_safe_link(link: str) -> bool:
    """Whether the text is an address of the web, with a host and without a user name."""
    try:
        parts = urlsplit(link)
        return bool(LINK.fullmatch(link) and parts.hostname and parts.username is None) and (parts.port or 0) >= 0
    except ValueError:  # the port is not a number
        return False
