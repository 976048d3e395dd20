"""A private list of initial states is checked when it is read, and evaluated in its order."""

import json

import pytest

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.evaluation.evaluate import Args, main
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.evaluation.seed_list import read_seeds
from tests.tasks_and_marks import PEG


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_list_is_read_with_comments(encoding, tmp_path):
    (tmp_path / "seeds.txt").write_text("734501\n\n# ours\n100000  # the first public one\n", encoding)
    assert read_seeds(tmp_path / "seeds.txt") == [734501, 100000]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no seed"),
        ("734501\nseven\n", "is no list of seeds .*seven"),
        ("734501\n734501\n", r"holds \[734501\] twice"),
        ("99999\n", r"holds \[99999\]; give seeds from 100000 to 4294967295: demonstrations use those below"),
        ("4294967296\n", r"holds \[4294967296\]"),
    ],
)
def test_what_is_wrong_with_a_list_is_said(text, said, tmp_path):
    (tmp_path / "seeds.txt").write_text(text)
    with pytest.raises(InvalidFileError, match=said):
        read_seeds(tmp_path / "seeds.txt")
    with pytest.raises(InvalidFileError, match="is no list of seeds"):
        read_seeds(tmp_path / "missing.txt")


def test_an_evaluation_has_the_seeds_of_the_list(tmp_path):
    (tmp_path / "seeds.txt").write_text("734501\n220011\n")
    kwargs = json.dumps(dict(render_backend="none", max_episode_steps=2))
    args = Args(policy="tests.evaluation.policies:StandStill", env_id=PEG, obs_mode="none", cameras=(), env_kwargs=kwargs)
    args.seeds, args.out = tmp_path / "seeds.txt", tmp_path / "evaluation.json"
    assert [episode["seed"] for episode in read_result(main(args))["episodes"]] == [734501, 220011]
