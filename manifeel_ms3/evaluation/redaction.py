"""Removal of passwords and tokens from everything that an evaluation writes, since results are published.

An entry counts as a secret by its name ("api_key"), or by its value: the password of an address
("http://user:password@host"), or a token of a common service ("hf_...").
"""

import re
from collections.abc import Iterator
from typing import Any

MARK = "(redacted)"
"""Mark that replaces a secret."""
SHORTEST_SECRET = 4
"""Smallest number of characters of a secret that is also replaced in messages; shorter ones occur by chance."""
_WORDS = (
    r"token|password|passwd|passphrase|pwd|secret|credentials?|auth|authorization|bearer|cookie|"
    r"(?:api|access|private|auth|secret)[_-]?key"
)
_NAME = re.compile(rf"(?:^|[_-])(?:{_WORDS})(?:$|[_-])", re.IGNORECASE)
_CAMEL_CASE = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
_VALUES = re.compile(
    r"(?<=://)(?P<login>[^/@\s]+)(?=@)"
    rf"|(?<=[?&])(?P<query>(?:[\w-]+[_-])?(?:{_WORDS})=[^&#\s]+)"
    r"|\b(?P<token>(?:hf_|sk-|gh[opsu]_|github_pat_|glpat-|xox[abprs]-|AKIA)[\w-]{8,})"
    r"|\b(?P<jwt>eyJ[\w-]+\.[\w-]+\.[\w-]+)"
    r"|(?<=Bearer )(?P<bearer>\S+)",
    re.IGNORECASE,
)


def redacted(value: Any) -> Any:
    """A copy of a json value in which a mark replaces every secret.

    Args:
        value: Any value that json knows; tuples may stand for lists.
    """
    if isinstance(value, dict):
        return {name: MARK if _is_secret(name, entry) else redacted(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [redacted(entry) for entry in value]
    return _VALUES.sub(MARK, value) if isinstance(value, str) else value


def secrets_in(value: Any) -> Iterator[str]:
    """The secrets that `redacted` replaces in a json value."""
    if isinstance(value, dict):
        for name, entry in value.items():
            yield from _leaves(entry) if _is_secret(name, entry) else secrets_in(entry)
    elif isinstance(value, (list, tuple)):
        for entry in value:
            yield from secrets_in(entry)
    elif isinstance(value, str):
        for found in _VALUES.finditer(value):
            yield from (found.group(), re.split("[:=]", found.group())[-1])


def without_secrets(text: str, secrets: list[str]) -> str:
    """A text, such as an error message, in which a mark replaces some secrets and everything that looks like one."""
    for secret in sorted(set(secrets), key=len, reverse=True):
        if len(secret) >= SHORTEST_SECRET:
            text = text.replace(secret, MARK)
    return redacted(text)


def _is_secret(name: Any, value: Any) -> bool:
    is_empty = value is None or value == "" or isinstance(value, bool)
    return not is_empty and bool(_NAME.search(_CAMEL_CASE.sub("_", str(name))))


def _leaves(value: Any) -> Iterator[str]:
    if isinstance(value, (dict, list, tuple)):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from _leaves(entry)
    elif value is not None:
        yield str(value)
