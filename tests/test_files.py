"""A file appears whole or not at all, and errors name the path."""

import json

import pytest

from manifeel_ms3.errors import InvalidFileError, ManifeelError
from manifeel_ms3.files import atomic_write, read_json, write_json, write_text

SCHEMA = {"type": "object", "required": ["count"], "properties": {"count": {"type": "integer"}}}


def test_json_is_read_as_it_was_written_and_folders_are_made(tmp_path):
    path = tmp_path / "folder/file.json"
    write_json(path, dict(count=3))
    assert read_json(path, SCHEMA, "a count") == dict(count=3)
    assert path.read_text() == json.dumps(dict(count=3), indent=2)
    assert [file.name for file in path.parent.iterdir()] == ["file.json"]


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "file.txt"
    write_text(path, "old")

    def write_half() -> None:
        with atomic_write(path) as partial:
            partial.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ManifeelError, match=r"file/page.html cannot be written \(.*exists"):
        write_text(tmp_path / "file/page.html", "")


@pytest.mark.parametrize(
    ("text", "reason"), [("{", "Expecting"), ("{}", "'count' is a required"), ('{"count": "x"}', "count: 'x'")]
)
def test_what_is_no_such_json_is_refused(tmp_path, text, reason):
    (tmp_path / "file.json").write_text(text)
    with pytest.raises(InvalidFileError, match=rf"file.json is not a count \(.*{reason}"):
        read_json(tmp_path / "file.json", SCHEMA, "a count")
    with pytest.raises(InvalidFileError, match=r"none.json is not a count \(.*No such file"):
        read_json(tmp_path / "none.json", SCHEMA, "a count")
