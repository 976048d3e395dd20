"""A few real demonstrations, recorded once."""

import json

import pytest

from manifeel_ms3.demonstrations import record
from tests.tasks_and_marks import PEG


@pytest.fixture(scope="session")
def demos(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "trajectory.h5"
    kwargs = json.dumps(dict(fit="paper", render_backend="none"))
    args = record.Args(PEG, 2, 1, 0, path, "tacff", cameras=(), tactile_sensors=("right",), env_kwargs=kwargs)
    return record.main(args)
