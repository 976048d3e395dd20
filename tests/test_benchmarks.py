"""The programs that measure speed look at what they say they do."""

from benchmarks import env_speed, teleop_rate
from tests.tasks_and_marks import needs_renderer


def test_every_part_of_a_step_without_images_of_cameras_is_found_in_its_profile(make_env):
    env = make_env(obs_mode="tacrgb+tacff", render_backend="none")
    env.reset(seed=0)
    shares = env_speed.shares(env, 2)
    assert shares.pop("rendering") == 0
    assert min(shares.values()) > 0
    assert sum(shares.values()) < 1


@needs_renderer
def test_the_rate_of_teleoperation_is_measured():
    assert teleop_rate.main(teleop_rate.Args(steps=2)) > 0
