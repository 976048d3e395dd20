"""One entry point: it lists, parses, completes and runs every command."""

import pytest

from manifeel_ms3 import cli
from tests.conftest import PEG


def test_all_commands_are_listed(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--help"])
    said = capsys.readouterr().out
    assert all(name in said and about[:30] in said for name, (_, about) in cli.COMMANDS.items())


def test_a_command_runs(capsys):
    assert cli.main(["tasks"]) == 0
    said = capsys.readouterr().out
    assert all(task in said for task in ("PegInsertion", "NutBoltAssembly", "BallSortingDim"))
    assert cli.main(["tasks", "PegInsertion"]) == 0
    assert "Success Conditions" in capsys.readouterr().out
    with pytest.raises(ValueError, match="no task 'Knitting'; choose from"):
        cli.main(["tasks", "Knitting"])


def test_a_flag_that_is_not_known_is_refused():
    with pytest.raises(SystemExit, match="2"):
        cli.main(["record", PEG, "--no-such-flag"])


def test_training_takes_policy_preset_and_flags(monkeypatch):
    from baselines.flow_matching import train

    trained = []
    monkeypatch.setattr(train, "main", trained.append)
    cli.main(["train", "flow_matching", "cpu", "--demos", "a.h5", "b.h5", "--policy.kernel", "3"])
    (args,) = trained
    assert [path.name for path in args.demos] == ["a.h5", "b.h5"]
    assert args.policy.kernel == 3
    assert args.policy.channels == train.PRESETS["cpu"][1].policy.channels


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_can_complete_commands_and_flags(shell, capsys):
    with pytest.raises(SystemExit):
        cli.main(["--tyro-print-completion", shell])
    said = capsys.readouterr().out
    for word in (*cli.COMMANDS, "equivariant_diffusion_policy", "--tactile-sensors", "--policy.pred-horizon", "--check-only"):
        assert word in said, word
