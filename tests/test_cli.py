"""One entry point: it lists, parses, completes and runs every command."""

import importlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import tyro

from baselines import floors
from baselines.flow_matching import train as flow_matching
from baselines.tactile_representations import pretrain
from manifeel_ms3 import cli, command_line, plugins, typed_modules
from manifeel_ms3.arguments import one_of
from manifeel_ms3.command_line import TRACEBACK, missing_extras_named, run
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.demonstrations.recording import next_step, train_command
from manifeel_ms3.errors import MissingExtraError
from manifeel_ms3.tasks.registry import task_spec
from tests.sample import observed_sample, states_sample
from tests.tasks_and_marks import PEG


def test_all_commands_are_listed(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--help"])
    said = capsys.readouterr().out
    assert all(
        name in said and about[:30] in said
        for name, about in ((name, command.about) for name, command in cli.all_commands().items())
    )


def test_the_help_of_a_command_says_what_it_does(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(["replay", "--help"])
    assert cli.COMMANDS["replay"].about in capsys.readouterr().out


def test_a_command_runs(capsys):
    assert cli.main(["tasks"]) == 0
    said = capsys.readouterr().out
    assert all(task in said for task in ("PegInsertion", "NutBoltAssembly", "BallSortingDim"))
    assert cli.main(["tasks", "PegInsertion"]) == 0
    assert "Success Conditions" in capsys.readouterr().out
    assert cli.main(["tasks", "BallSortingDim"]) == 0
    said = capsys.readouterr().out
    assert "5 % of the light" in said
    assert "Success Conditions" in said
    assert cli.main(["tasks", "Knitting"]) == 1
    said = capsys.readouterr().err
    assert "error: the task 'Knitting' is not registered; registered are" in said
    page = re.search(r"more: (\S+troubleshooting\.md)", said)
    assert page
    assert Path(page[1]).is_file()


def test_a_command_ends_with_what_it_made_and_what_takes_it(tmp_path, caplog):
    path = tmp_path / "x.h5"
    with caplog.at_level("INFO"):
        assert cli.main(["record", "PegInsertion", "-n", "1", "--obs-mode", "none", "--out", str(path)]) == 0
    assert caplog.messages[-1] == f"{path} holds 1 episode; `manifeel render-observations {path} --out FILE` adds observations"
    assert next_step(None, observed_sample(PEG)).endswith(
        f"--env-id {PEG} --obs-mode rgb+tacff --cameras wrist` trains a policy"
    )
    header = read_header(observed_sample(PEG))
    header["env_info"]["env_kwargs"]["tactile_sensors"] = ["left"]
    assert train_command(path, header).endswith("--cameras wrist --tactile-sensors left`")
    header["env_info"]["env_kwargs"]["obs_mode"] = "tacff"
    assert train_command(path, header).endswith("--obs-mode tacff --tactile-sensors left`")


@pytest.mark.parametrize(
    ("recorded", "learnt"),
    [("rgb+depth+tacff", "rgb+tacff"), ("rgbd", "rgb"), ("state_dict+tacrgb", "tacrgb"), ("state+tacff", ""), ("state", "")],
)
def test_the_command_after_a_recording_asks_for_observations_that_policies_take(recorded, learnt, tmp_path):
    path = tmp_path / "x.h5"
    header = read_header(observed_sample(PEG))
    header["env_info"]["env_kwargs"]["obs_mode"] = recorded
    path.with_suffix(".json").write_text(json.dumps(header))
    shutil.copy(observed_sample(PEG), path)
    said = next_step(None, path)
    assert bool(re.search(rf"--obs-mode {re.escape(learnt)}[ `]", said)) == bool(learnt)
    assert ("`manifeel render-observations" in said) == (not learnt)


SAYS_IT_ALL = {"tasks", "doctor", "view", "teleop"}
"""Commands that make nothing, or whose page or window itself says what they make."""


@pytest.mark.parametrize("name", sorted(cli.all_commands()))
def test_every_command_says_what_comes_next(name):
    assert hasattr(cli.command_module(name), "next_step") == (name not in SAYS_IT_ALL)


@pytest.mark.parametrize(
    "arguments",
    [
        ["validate", str(states_sample(PEG))],
        ["replay", str(states_sample(PEG)), "-n", "1"],
        ["summary", str(states_sample(PEG))],
        ["claims", "--results", "leaderboard/cpu"],
        ["leaderboard", "build", "--board", "BOARD"],
        ["study", "configs/smoke.yaml", "--print-commands"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_the_last_line_names_commands_that_exist(arguments, tmp_path, caplog):
    shutil.copytree("leaderboard/cpu", tmp_path / "cpu", ignore=shutil.ignore_patterns("checkpoints"))
    with caplog.at_level("INFO"):
        assert cli.main([word.replace("BOARD", str(tmp_path)) for word in arguments]) == 0
    last = caplog.messages[-1]
    assert "`" in last or "browser" in last
    for command, flags in re.findall(r"`manifeel (\S+)([^`]*)`", last):
        assert command in cli.all_commands()
        taken = tyro.extras.get_parser(cli.command_module(command).Args).format_help()
        assert all(flag in taken for flag in re.findall(r"--[a-z-]+", flags)), last


@pytest.mark.parametrize("policy", ["diffusion_policy", "flow_matching", "equivariant_diffusion_policy"])
def test_training_by_script_ends_as_the_command_does(policy):
    module = importlib.import_module(f"baselines.{policy}.train")
    assert module.next_step is cli.command_module("train").next_step


def test_training_without_a_preset_says_which_there_are(capsys):
    assert cli.main(["train", "diffusion_policy", "--demos", "peg.h5"]) == 1
    said = capsys.readouterr().err.splitlines()[0]
    assert "needs the name of a preset" in said
    assert "cpu (" in said
    assert "paper (" in said


@pytest.mark.parametrize("arguments", [[], ["cpu", "--demos", "peg.h5"], ["--demos", "peg.h5"], ["difusion_policy", "cpu"]])
def test_training_without_a_policy_says_which_there_are(arguments, capsys):
    assert cli.main(["train", *arguments]) == 1
    said = capsys.readouterr().err.splitlines()[0]
    assert "needs the name of a policy before that of a preset; choose from ['diffusion_policy', 'equivariant_" in said


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (["diffusion_policy", "cpuu"], "cpu"),
        (["flow_matching", "papre"], "paper"),
        (["difusion_policy", "cpu"], "diffusion_policy"),
    ],
)
def test_training_with_a_misspelt_name_says_which_is_near(given, meant, capsys):
    assert cli.main(["train", *given, "--demos", "peg.h5"]) == 1
    assert capsys.readouterr().err.splitlines()[0].endswith(f"; did you mean {meant!r}?")


def test_an_unknown_observation_is_refused_before_a_process_is_started(tmp_path, capsys):
    out = tmp_path / "new" / "peg.h5"
    assert cli.main(["record", PEG, "-n", "1", "--obs-mode", "rgb+foo", "--out", str(out)]) == 1
    said = capsys.readouterr()
    assert "token 'foo' is unknown" in said.err
    assert "recording" not in said.out  # no progress bar has begun
    assert not out.parent.exists()


def test_a_refusal_is_a_message_and_a_fault_keeps_its_traceback(monkeypatch, capsys):
    def refuse(_):
        one_of("fit", "huge", ("paper", "tight"))

    assert run(refuse, None) == 1
    assert "fit='huge' is unknown" in capsys.readouterr().err
    with pytest.raises(json.JSONDecodeError):  # raised elsewhere: a fault, or at least not ours to explain
        run(lambda _: json.loads("{"), None)
    with pytest.raises(KeyError):
        run(lambda _: {}["a"], None)
    monkeypatch.setenv(TRACEBACK, "1")
    with pytest.raises(ValueError, match="fit='huge'"):
        run(refuse, None)


@pytest.mark.parametrize(
    ("given", "spins"), [({}, "3000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "active"}, None)]
)
def test_torchs_threads_do_not_wait_in_a_loop_for_long(given, spins):
    """OpenMP reads the variable when torch is loaded."""
    program = f"""
import os, sys
class Watch:
    def find_spec(self, name, *_):
        if name == "torch":
            assert os.environ.get("GOMP_SPINCOUNT") == {spins!r}
            print("loaded")
sys.meta_path.insert(0, Watch())
import manifeel_ms3
"""
    environment = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment | given)
    assert (done.returncode, done.stdout) == (0, "loaded\n"), done.stderr


def test_importing_the_package_changes_no_global_hook():
    program = (
        "import os, sys, logging, signal, warnings\n"
        "def state():\n"
        "    return sys.excepthook, sys.displayhook, warnings.showwarning, logging.root.level, logging.root.handlers[:], [\n"
        "        signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)]\n"
        "import gymnasium, torch, mani_skill.envs, sapien\n"
        "import warp\n"
        "before = state(), vars(warp.config).copy()\n"
        "os.register_at_fork = lambda **hooks: (_ for _ in ()).throw(AssertionError(hooks))\n"
        "import manifeel_ms3, baselines.registry\n"
        "assert sys.excepthook is sys.__excepthook__\n"
        "assert (state(), vars(warp.config)) == before, before"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("mistake", [f"gymnasium.make('{PEG}', obs_mode='smell')", "1 / 0"])
def test_a_program_of_ones_own_gets_tracebacks(mistake):
    program = f"import gymnasium, manifeel_ms3; {mistake}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "Traceback" in done.stderr
    assert "more: " not in done.stderr


def test_a_library_of_an_extra_is_named_with_the_extra(monkeypatch, capsys):
    def import_it(module):
        with missing_extras_named():
            importlib.import_module(module)

    for module, extra in dict(pyspacemouse="spacemouse", sklearn="audit", rerun="view", ray="study", yaml="study").items():
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError):
            import_it(module)
        assert run(import_it, module) == 1
        assert f"{module} is not installed: pip install 'manifeel-ms3[{extra}]'" in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError, match="no_library_of_ours"):
        run(import_it, "no_library_of_ours")  # no extra would install it: a fault, with its traceback
    monkeypatch.setitem(sys.modules, "zarr", None)
    monkeypatch.setattr(command_line, "requires", lambda _: ["zarr>=3; python_version >= '3.98' and extra == 'zarr'"])
    assert run(import_it, "zarr") == 1
    newer = f"it needs a newer Python than {platform.python_version()}; there, pip install 'manifeel-ms3[zarr]'"
    assert f"zarr is not installed: {newer}" in capsys.readouterr().err


def test_a_command_without_its_extra_is_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    for module in ("__main__", "running"):  # the one that imports Ray as well
        monkeypatch.delitem(sys.modules, f"baselines.studies.{module}", raising=False)
    assert cli.main(["study", "configs/smoke.yaml"]) == 1
    assert "error: ray is not installed: pip install 'manifeel-ms3[study]'" in capsys.readouterr().err


def test_a_plug_in_without_an_extra_names_the_extra(monkeypatch):
    def load():
        raise ModuleNotFoundError("No module named 'diffusers'", name="diffusers")

    monkeypatch.setattr(plugins, "registered", lambda _: dict(lacking=SimpleNamespace(load=load)))
    with pytest.raises(MissingExtraError, match=r"diffusers is not installed: pip install 'manifeel-ms3\[train\]'"):
        plugins.load("manifeel.policies", "lacking")


@pytest.mark.parametrize(("program", "lines"), [("manifeel", 1), ("of_ones_own", None)])
def test_a_command_without_a_dependency_is_one_line(program, lines):
    code = f"import sys; sys.modules['torch'] = None; sys.argv = ['bin/{program}', 'doctor']; import manifeel_ms3"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert ("Traceback" in done.stderr) == (lines is None)
    assert lines is None or len(done.stderr.splitlines()) == lines
    assert "torch" in done.stderr


def test_what_a_worker_refuses_is_a_message_too(tmp_path, capsys):
    arguments = ["record", PEG, "-n", "4", "--obs-mode", "none", "--out", str(tmp_path / "peg.h5"), "--env-kwargs"]
    assert cli.main([*arguments, '{"fit": "huge"}']) == 1
    assert "error: fit='huge' is unknown; choose from ['paper', 'tight']" in capsys.readouterr().err
    assert cli.main([*arguments, "{fit: huge}"]) == 1
    assert "--env-kwargs '{fit: huge}' is not json" in capsys.readouterr().err


def test_answers_that_count_what_is_wrong_are_exit_codes():
    assert [run(lambda answer: answer, answer) for answer in (0, 7, None, Path("made"))] == [0, 1, 0, 0]

    def interrupted(_):
        raise KeyboardInterrupt

    assert run(interrupted, None) == 130


@pytest.mark.parametrize(
    ("program", "code", "said"), [("manifeel", 130, "stopped\n"), ("my_program.py", -signal.SIGINT, "KeyboardInterrupt\n")]
)
def test_a_command_that_is_interrupted_while_it_starts_says_so_in_one_line(program, code, said, tmp_path):
    (tmp_path / "torch.py").write_text("raise KeyboardInterrupt")
    start = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); sys.argv = [{program!r}]; from manifeel_ms3.cli import main"
    ran = subprocess.run([sys.executable, "-c", start], capture_output=True, text=True, check=False)
    assert ran.returncode == code
    assert ran.stderr.endswith(said)
    assert ("Traceback" in ran.stderr) == (program != "manifeel")


def test_names_that_are_not_known_are_refused_and_the_nearest_is_named(capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["record", PEG, "--obs-moed", "tacff"])
    said = " ".join(re.sub(r"[^\w.-]+", " ", capsys.readouterr().err).split())
    assert "Perhaps you meant --obs-mode" in said
    with pytest.raises(SystemExit, match="2"):
        cli.main(["train", "diffusion_policy", "cpu", "--demo-path", "x.h5", "--total-iter", "5"])
    said = " ".join(re.sub(r"[^\w.-]+", " ", capsys.readouterr().err).split())
    assert "--total-iters" in said.partition("Perhaps you meant")[2]
    assert "manifeel train diffusion_policy cpu --help" in said
    assert "cpu_long" not in said
    assert cli.main(["recrod", PEG]) == 1
    said = capsys.readouterr().err
    assert "'recrod' is not a command; choose from ['tasks'" in said
    assert "]; did you mean 'record'?" in said
    assert cli.main(["record", PEG, "-n", "0"]) == 1
    assert "--num-demos 0: at least 1" in capsys.readouterr().err
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("manifeel-ms3 ")


def test_flags_have_maniskills_names_and_their_old_ones():
    train = cli.command_module("train")
    parse = partial(tyro.cli, train.Args)
    theirs = "--demo-path a.h5 --total-iters 7 --save-freq 3 --log-freq 2 --num-eval-episodes 4 --num-eval-envs 2 --track"
    ours = "--demos a.h5 --steps 7 --save-every 3 --log-every 2 --eval-episodes 4 --eval-workers 2 --track"
    named = "--exp-name x --num-demos 5 --eval-freq 6 --wandb-project-name y --wandb-entity z --capture-video"
    theirs += f" {named} --obs-horizon 3 --act-horizon 5 --pred-horizon 12"
    ours += f" {named} --policy.obs-horizon 3 --policy.action-horizon 5 --policy.pred-horizon 12"
    assert parse(args=["flow_matching", "cpu", *theirs.split()]) == parse(args=["flow_matching", "cpu", *ours.split()])
    assert train.parse(["flow_matching", "cpu", *theirs.split()]) == parse(args=["flow_matching", "cpu", *theirs.split()])
    evaluate = partial(tyro.cli, cli.command_module("eval").Args)
    assert evaluate(args=["--num-eval-episodes", "3", "--num-eval-envs", "2"]) == evaluate(
        args=["--episodes", "3", "--workers", "2"]
    )
    for args, theirs, ours in (
        (pretrain.Args, "t3 --demo-path a.h5 --total-iters 7 --log-freq 2", "t3 --demos a.h5 --steps 7 --log-every 2"),
        (
            floors.Args,
            "--num-eval-episodes 3 --num-eval-envs 2 --demo-path demos",
            "--episodes 3 --workers 2 --demos demos",
        ),
        (cli.command_module("leaderboard").Args, "submit x --num-eval-envs 2", "submit x --workers 2"),
        (cli.command_module("audit").Args, "--demo-path demos", "--demos demos"),
    ):
        assert tyro.cli(args, args=theirs.split()) == tyro.cli(args, args=ours.split())
    for command in ("record", "replay", "render-observations"):
        module = cli.command_module(command)
        positional = [PEG] if command == "record" else ["a.h5", *(["--out", "b.h5"] if command != "replay" else [])]
        counts = [tyro.cli(module.Args, args=[*positional, flag, "3"]).num for flag in ("--num-demos", "--num", "-n")]
        assert counts == [3, 3, 3]


def test_a_task_may_be_named_shortly():
    assert task_spec("PegInsertion") is task_spec(PEG)


def test_training_takes_policy_preset_and_flags():
    arguments = ["flow_matching", "cpu", "--demos", "a.h5", "b.h5", "--policy.action-horizon", "3"]
    args = tyro.cli(cli.command_module("train").Args, args=arguments)
    assert type(args) is flow_matching.Args
    assert [path.name for path in args.demos] == ["a.h5", "b.h5"]
    assert args.policy.action_horizon == 3
    assert args.policy.encoder == flow_matching.PRESETS["cpu"].args.policy.encoder


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_can_complete_commands_and_flags(shell, capsys):
    with pytest.raises(SystemExit):
        cli.main(["--tyro-print-completion", shell])
    said = capsys.readouterr().out
    for word in (
        *cli.all_commands(),
        "equivariant_diffusion_policy",
        "--tactile-sensors",
        "--policy.pred-horizon",
        "--check-only",
    ):
        assert word in said, word


@pytest.mark.parametrize("flag", ["--control-mode", "--sim_backend", "--max_episode_steps=300", "--demo_type"])
def test_a_flag_that_only_maniskills_scripts_have_is_explained(flag, capsys):
    assert cli.main(["train", "diffusion_policy", "cpu", "--demo-path", "x.h5", flag, "y"]) == 1
    name = flag.partition("=")[0].replace("_", "-")
    assert capsys.readouterr().err.startswith(f"error: {name} is a flag of ManiSkill's baselines; leave it out: ")


def test_a_misspelt_task_or_preset_is_named_with_the_nearest(capsys):
    for typed in ("PegInsertoin", "peginsertion", "ManiFeel-PegInsertoin-v1"):
        assert cli.main(["tasks", typed]) == 1
        assert "did you mean 'PegInsertion'?" in capsys.readouterr().err
    assert cli.main(["train", "diffusion_policy", "cpuu", "--demo-path", "x.h5"]) == 1
    assert "has no preset 'cpuu'; choose from" in capsys.readouterr().err


def test_the_command_after_training_names_the_module_of_a_task_that_was_typed_with_it(monkeypatch):
    monkeypatch.setattr(typed_modules, "_imported", ["lift_block"])
    said = cli.command_module("train").next_step(None, Path("last"))
    assert "`MANIFEEL_TASKS=lift_block manifeel eval --checkpoint last` evaluates it" in said
