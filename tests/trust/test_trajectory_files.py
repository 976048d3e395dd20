"""Trajectory files read nothing outside of themselves and take no more memory than they hold."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from manifeel_ms3.demonstrations import DemonstrationError, read_demonstrations
from manifeel_ms3.demonstrations.export import Args
from manifeel_ms3.demonstrations.export import main as export
from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories
from manifeel_ms3.demonstrations.summary import summary
from tests.sample import KEYS

from .files_of_strangers import SAMPLE


def with_dataset(path: Path, make) -> None:
    """Replace the actions of the first episode by what `make` puts there."""
    with h5py.File(path, "r+") as file:
        del file["traj_0/actions"]
        make(file["traj_0"])


def declared(group, shape: tuple[int, ...], **options) -> None:
    """A data set of which nothing is stored."""
    space, kind = h5py.h5s.create_simple(shape), h5py.h5t.IEEE_F32LE
    group.create_dataset("actions", shape, "f4", **options) if options else h5py.h5d.create(group.id, b"actions", kind, space)


def virtual(group, secret: Path) -> None:
    layout = h5py.VirtualLayout((4, 6), "f4")
    layout[:] = h5py.VirtualSource(str(secret), "x", (4, 6))
    group.create_virtual_dataset("actions", layout)


def second_place(group, _secret: Path) -> None:
    group["actions"] = group["obs/extra/tcp_pose"]


HARM = {
    "external storage": lambda group, secret: group.create_dataset("actions", (2, 4), "f4", external=[(str(secret), 0, 32)]),
    "external link": lambda group, secret: group.update({"actions": h5py.ExternalLink(str(secret), "/x")}),
    "soft link": lambda group, _: group.update({"actions": h5py.SoftLink("/traj_0/obs/extra/tcp_pose")}),
    "virtual data set": virtual,
    "hard link": second_place,
    "2**40 numbers, contiguous": lambda group, _: declared(group, (2**20, 2**20)),
    "2**40 numbers, in chunks": lambda group, _: declared(group, (2**20, 2**20), chunks=(1, 6), compression="gzip"),
    "2**64 numbers": lambda group, _: declared(group, (2**32, 2**32), chunks=(1, 6), compression="gzip"),
    "another filter": lambda group, _: group.create_dataset("actions", data=np.zeros((4, 6)), scaleoffset=3),
    "strings": lambda group, _: group.create_dataset("actions", data=[["text"]]),
    "references": lambda group, _: group.create_dataset("actions", data=[[group.ref]], dtype=h5py.ref_dtype),
    "a group": lambda group, _: group.create_group("actions"),
    "another shape": lambda group, _: group.create_dataset("actions", data=np.zeros(6)),
    "no numbers": lambda group, _: group.create_dataset("actions", data=np.zeros((0, 6))),
}


LINKS, ELSEWHERE = "/traj_0/actions is a link to another place or file", "the numbers of /traj_0/actions are in another file"
DECLARED, NUMBERS = (
    r"/traj_0/actions declares \d+ bytes .*, of which 0 are stored",
    "actions holds something other than numbers",
)
FORM = "/traj_0/actions is not what a trajectory file has there"
REASONS = {
    "external storage": ELSEWHERE,
    "external link": LINKS,
    "soft link": LINKS,
    "virtual data set": ELSEWHERE,
    "hard link": "is the same object as another part",
    "2**40 numbers, contiguous": DECLARED,
    "2**40 numbers, in chunks": DECLARED,
    "2**64 numbers": DECLARED,
    "another filter": r"/traj_0/actions is stored with the filters \[6\]",
    "strings": NUMBERS,
    "references": NUMBERS,
    "a group": FORM,
    "another shape": FORM,
    "no numbers": FORM,
}
"""What the error says of each kind of harm."""


@pytest.mark.parametrize("kind", HARM)
def test_a25_a_trajectory_file_is_refused(kind, demo, secret):
    with_dataset(demo, lambda group: HARM[kind](group, secret))
    for read in (
        lambda: read_demonstrations(demo, KEYS),
        lambda: summary(demo),
        lambda: export(Args(demo, "npz", demo.parent / "o")),
    ):
        with pytest.raises(DemonstrationError, match=REASONS[kind]):
            read()


@pytest.mark.parametrize(
    ("file", "place"),
    [
        ("../elsewhere/other.h5", "traj_0"),
        ("trajectory.episodes/../elsewhere/other.h5", "traj_0"),
        ("trajectory.episodes/link.h5", "traj_0"),
        ("trajectory.episodes/seed_00000000.h5", "traj_1"),
        ("trajectory.episodes/missing.h5", "traj_0"),
    ],
)
def test_a25_an_index_links_to_its_own_episodes_alone(file, place, tmp_path, secret):
    shutil.copy(SAMPLE.with_suffix(".json"), tmp_path / "trajectory.json")
    episodes, other = tmp_path / "trajectory.episodes", secret.with_name("other.h5")
    episodes.mkdir()
    for target in (other, episodes / "seed_00000000.h5"):
        shutil.copy(SAMPLE, target)
    (episodes / "link.h5").symlink_to(other)
    with h5py.File(tmp_path / "trajectory.h5", "w") as index:
        index["traj_0"] = h5py.ExternalLink(file, place)
    reason = (
        "is the index of .*missing.h5, which does not exist" if "missing" in file else "an index links only to files in traj"
    )
    with pytest.raises(DemonstrationError, match=reason):
        read_demonstrations(tmp_path / "trajectory.h5", KEYS, num=1)
    with h5py.File(tmp_path / "trajectory.h5", "w") as index:
        index["traj_0"] = h5py.ExternalLink("trajectory.episodes/seed_00000000.h5", "traj_0")
    assert len(read_demonstrations(tmp_path / "trajectory.h5", KEYS, num=1)) == 1


def test_a25_an_episode_of_an_index_is_checked_too(tmp_path, secret):
    shutil.copy(SAMPLE.with_suffix(".json"), tmp_path / "trajectory.json")
    episodes = tmp_path / "trajectory.episodes"
    episodes.mkdir()
    shutil.copy(SAMPLE, episodes / "seed_00000000.h5")
    with_dataset(episodes / "seed_00000000.h5", lambda group: HARM["external storage"](group, secret))
    with h5py.File(tmp_path / "trajectory.h5", "w") as index:
        index["traj_0"] = h5py.ExternalLink("trajectory.episodes/seed_00000000.h5", "traj_0")
    with (
        pytest.raises(DemonstrationError, match="are in another file"),
        open_trajectories(tmp_path / "trajectory.h5") as file,
    ):
        file["traj_0/actions"][()]


@pytest.mark.parametrize("fault", [KeyError, TypeError, ValueError, RuntimeError, OSError, MemoryError])
def test_a_fault_of_the_code_that_reads_is_not_said_of_the_file(fault):
    def read(compute) -> None:
        with open_trajectories(SAMPLE) as file:
            compute(file["traj_0/actions"][()])
            file["traj_0/knitting"][()]

    def fail(_actions: np.ndarray) -> None:
        raise fault("a fault of this program")

    with pytest.raises(fault, match="a fault of this program") as raised:
        read(fail)
    assert raised.type is fault
    with pytest.raises(DemonstrationError, match=r"cannot be read as a trajectory .*'knitting' doesn't exist"):
        read(len)
