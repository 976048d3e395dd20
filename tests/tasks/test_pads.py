"""Touch in the tasks: what the pads feel, how they are chosen, and when they are computed."""

import numpy as np
import pytest
import torch

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.sensors import TactileSensor


def test_touch_is_computed_once_a_step_and_only_where_asked_for(make_env, monkeypatch):
    captures = []
    capture = TactileSensor.capture
    monkeypatch.setattr(TactileSensor, "capture", lambda self, *args: (captures.append(self.uid), capture(self, *args)))
    env = make_env(obs_mode="tacff", tactile_sensors=("left",), render_backend="none")
    env.reset(seed=0)
    captures.clear()
    for _ in range(3):
        env.step(np.zeros(6))
    assert captures == ["tactile_left"] * 3
    env = make_env(obs_mode="state", render_backend="none")
    env.reset(seed=0)
    captures.clear()
    env.step(np.zeros(6))
    assert captures == []


def test_contact_force_is_the_weight_at_rest_and_the_largest_force_of_a_step(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    assert env.reset(seed=0)[1]["contact_force"].item() == 0
    base, still = env.unwrapped, np.zeros(6)
    weight = 9.81 * base.plug.mass.item()
    for _ in range(3):
        *_, info = env.step(still)
    assert info["contact_force"].item() == pytest.approx(weight, rel=0.03)
    base.plug._bodies[0].add_force_torque([0.0, 0.0, 30.0], [0.0, 0.0, 0.0])  # in the first physics step alone
    *_, info = env.step(still)
    assert info["contact_force"] > 5 * weight
    env.step(still)
    *_, info = env.step(still)
    assert info["contact_force"].item() == pytest.approx(weight, rel=0.03)


def test_force_field_equals_the_wrench_and_the_weight(make_env):
    env = make_env(obs_mode="tacff", tactile_sensors=("left", "right"), render_backend="none")
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        for _ in range(5):
            obs, *_ = env.step(np.zeros(6))
        base, total = env.unwrapped, torch.zeros(3)
        for side in ("left", "right"):
            field = obs["sensor_data"][f"tactile_{side}"]["force_field"][0].sum((0, 1))
            fx, fy, fz, *_ = base.agent.pad_wrench(side)[0].tolist()
            assert field.tolist() == pytest.approx([-fz, fx, fy], rel=0.01, abs=1e-3)
            rotation = torch.as_tensor(base.agent.gels[side].pose.sp.to_transformation_matrix()[:3, :3]).float()
            total += rotation @ torch.tensor([field[1], field[2], -field[0]])
        weight = float(base.plug.mass[0]) * 9.81
        assert total.tolist() == pytest.approx([0, 0, -weight], abs=0.02 * weight)


def test_a_pad_that_is_not_there_is_named(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    with pytest.raises(InvalidArgumentError, match=r"side='middle' is unknown; choose from \['left', 'right'\]"):
        env.unwrapped.agent.pad_wrench("middle")


def test_sensor_configs_reach_pads_as_well(make_env):
    pad = dict(units="tacsl", optics=dict(noise=2.0))
    env = make_env(obs_mode="tacff", render_backend="none", sensor_configs=dict(tactile_right=pad, width=64)).unwrapped
    config = env._tactile_sensors["tactile_right"].config
    assert (config.units, config.optics.noise) == ("tacsl", 2.0)


def test_a_pad_takes_the_width_and_height_of_maniskills_cameras(make_env):
    env = make_env(obs_mode="tacrgb", sensor_configs=dict(tactile_right=dict(width=160, height=120)))
    obs, _ = env.reset(seed=0)
    assert obs["sensor_data"]["tactile_right"]["rgb"].shape == (1, 120, 160, 3)


def test_pads_on_fingers_of_different_sizes_are_refused(make_env):
    options = dict(obs_mode="tacff", render_backend="none", sensor_configs=dict(tactile_left={"gel.size": (0.026, 0.034)}))
    with pytest.raises(InvalidArgumentError, match="both fingers are alike"):
        make_env(tactile_sensors=("left", "right"), **options)
    assert make_env(tactile_sensors=("left",), **options).unwrapped._finger.gel_size == (0.026, 0.034)


def test_two_pads_are_two_sensors(make_env):
    """Both pads of the same kind, in the same episode: neither their imperfections nor their noise are the same."""
    amounts = dict(gain=(0.0, 0.2), noise=0.05, dead_taxels=0.1)
    env = make_env(obs_mode="tacff", render_backend="none", tactile_sensors=("left", "right"), imperfections=amounts)
    _, info = env.reset(seed=0)
    left, right = (info["imperfections"][f"tactile_{side}"] for side in ("left", "right"))
    assert not torch.equal(left["gain"], right["gain"])
    noise = [env.unwrapped._tactile_sensors[f"tactile_{side}"].model._imperfections._seed for side in ("left", "right")]
    assert not torch.equal(*noise)


def test_a_gel_that_is_caught_from_behind_is_not_taken_for_one_on_the_wrong_side(make_env, monkeypatch, caplog):
    """The peg presses both gels at the start, so that they face the right way, whatever pulls them later."""
    env = make_env(obs_mode="tacff", render_backend="none")
    env.reset(seed=0)
    sensor = env.unwrapped._tactile_sensors["tactile_right"]
    pulled = torch.tensor([[0.0, 0.0, 2.0, 0.0, 0.0, 0.0]], dtype=sensor.wrench().dtype)
    monkeypatch.setattr(sensor, "wrench", lambda: pulled)
    sensor.capture()
    assert "faces away" not in caplog.text
