"""Links of Markdown pages and of the site that lead nowhere."""

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
NOT_FOUND = "404.html"  # its links begin with the address of the site


def missing_targets(page: Path) -> list[str]:
    """Relative links of a Markdown page to files that do not exist."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = (urlsplit(target) for target in LINK.findall(text))
    paths = (unquote(target.path) for target in targets if not target.scheme and target.path)
    return [path for path in paths if not (page.parent / path).exists()]


class _Page(HTMLParser):
    """Links and anchors of an HTML page."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.anchors = {"", "__skip"}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors |= {name for name in (given.get("id"), given.get("name")) if name}
        self.links += [link for name in ("href", "src", "poster") if (link := given.get(name))]


def dead_links(site: Path) -> list[str]:
    """Links within a built site to files or anchors that do not exist."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    dead = []
    for path, page in pages.items():
        for link in page.links if path.name != NOT_FOUND else ():
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            anchors = pages[target].anchors if target in pages else {unquote(parts.fragment)}
            if not target.is_file() or unquote(parts.fragment) not in anchors:
                dead.append(f"{path.relative_to(site)}: {link}")
    return dead
