"""Texts from files of other people, made safe to show in a terminal and on a page."""

LONGEST_SHOWN = 200
"""Largest number of characters of a text that is shown."""
CUT = "..."
"""End of a text that was cut off."""
ENTITIES = {character: f"&#{ord(character)};" for character in "&<>\"'|~$@^"}
ESCAPES = {character: f"\\{character}" for character in "\\`*_{}[]#!"}
"""Characters that HTML entities replace in Markdown, and those that a backslash escapes."""


def one_line(text: str) -> str:
    """The text in one line of limited length, without control characters and those that turn the direction of writing."""
    kept = " ".join("".join(letter if letter.isprintable() else " " for letter in text[: 2 * LONGEST_SHOWN]).split())
    return kept if len(kept) <= LONGEST_SHOWN else kept[: LONGEST_SHOWN - len(CUT)] + CUT


def markdown_text(text: str) -> str:
    """The text in one line of Markdown that shows its characters as they are, and not as markup, HTML or a border of a cell."""
    return "".join(ENTITIES.get(letter) or ESCAPES.get(letter, letter) for letter in one_line(text))
