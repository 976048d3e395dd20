"""`manifeel verify-sensor`: the page, the bounds and the exit code."""

import re
from dataclasses import replace

import numpy as np
import pytest
import sapien

from manifeel_ms3.command_line import run
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError
from manifeel_ms3.sensors import GelConfig
from manifeel_ms3.sensors.registry import task_sensor
from manifeel_ms3.verification.__main__ import Args, main
from manifeel_ms3.verification.checks import Check, checks_of, loop_area
from manifeel_ms3.verification.loads import KNOWN_LIMITS, SHAPES, Measurements, Reading, ball_depth, measure

pytest.importorskip("jinja2")


@pytest.fixture
def two_shapes(monkeypatch):
    """A box and a ball, so that it takes seconds."""
    for name in [name for name in SHAPES if name not in ("ball, 10 mm", "box, 8 x 10 mm")]:
        monkeypatch.delitem(SHAPES, name)
    monkeypatch.delitem(KNOWN_LIMITS, "edge of a box")
    monkeypatch.setattr("manifeel_ms3.verification.loads.LOOP_LOADS", (5.0, 10.0))
    monkeypatch.setattr("manifeel_ms3.verification.loads.DEPTH_LOADS", (3.0,))
    monkeypatch.setattr("manifeel_ms3.verification.__main__.COLOURS", ("red", "blue"))


def test_a_sound_sensor_has_a_page_and_exit_code_0(two_shapes, tmp_path):
    page = tmp_path / "sensor.html"
    assert run(main, Args("digit", report=page, loads=(0.1, 10.0))) == 0
    text = page.read_text()
    for wanted in ("digit", "manifeel-ms3", "commit", "centre of pressure", "<svg", "ball, 10 mm", "data:image/png;base64,"):
        assert wanted in text
    assert text.count(">holds<") == 8  # no published colours of a DIGIT
    assert ">broken<" not in text
    row = text[text.index("<td>centre of pressure, post, 4 mm at 10 N") :]
    assert ">known limit<" in row[: row.index("</tr>")]  # shown without a bound
    assert not re.search(r'(src|href)="http', text)  # needs nothing else


def test_a_broken_bound_is_shown_and_the_exit_code_is_not_0(two_shapes, tmp_path):
    page = tmp_path / "sensor.html"
    arguments = dict(tactile='{"gel.friction": 0.1}', imperfections='{"gain": 0.5, "hysteresis": 0.2}', loads=(3.0,))
    assert run(main, Args("gelsight_r15", report=page, **arguments)) == 1
    text = page.read_text()
    for broken in ("normal force", "shear", "loading and unloading"):
        row = text[text.index(f"<td>{broken}") :]
        assert row[: row.index("</tr>")].count("broken") == 2, broken  # the class and the word
    assert "gel.friction" in text


def test_a_pad_that_is_not_where_its_configuration_says_breaks_bounds(two_shapes):
    """Its field still fits the force that it measures itself, so that only what was applied can tell."""
    off = dict(pad_pose=sapien.Pose([1e-3, 0, 0]))
    found = measure("gelsight_r15", (3.0,), off)
    worst = {check.claim: check for check in checks_of(found, task_sensor("gelsight_r15", "a", "b", off, {}))}
    ball = worst["centre of pressure of balls against the ball's middle"]
    assert ball.worst == pytest.approx(1.0, rel=0.01)  # mm
    assert not ball.holds
    assert worst["centre of pressure of box, plate and rod against the force on the pad"].holds
    moment = worst["moment about the normal against the moment applied, over the load"]
    assert moment.worst > 10 * 0.0141  # mm; of a pad that is in its place, at most this much


def test_loads_that_the_gel_cannot_carry_are_named(two_shapes):
    heavy = measure("digit", (1000.0,))
    with pytest.raises(InvalidArgumentError, match="1000 N: it would reach the housing"):
        checks_of(heavy, task_sensor("digit", "a", "b", {}, {}))
    without_ball = measure("gelsight_r15", (30.0,))
    claims = [check.claim for check in checks_of(without_ball, task_sensor("gelsight_r15", "a", "b", {}, {}))]
    assert any("box, plate and rod" in claim for claim in claims)
    assert not any("balls" in claim for claim in claims)


def test_what_cannot_be_verified_is_named(tmp_path):
    with pytest.raises(UnknownNameError, match="choose from"):
        main(Args("biotac"))
    with pytest.raises(UnknownNameError, match="wobble"):
        main(Args(imperfections='{"wobble": 1}'))
    for loads in ((1.0, -3.0), (1.0, float("nan")), (float("inf"),)):
        with pytest.raises(InvalidArgumentError, match="positive forces"):
            main(Args(loads=loads))
    with pytest.raises(InvalidArgumentError, match=r"--report .* is a folder; give the path of a file, such as .*sensor\.html"):
        main(Args(report=tmp_path))
    with pytest.raises(InvalidArgumentError, match="folds"):
        main(Args("digit", tactile='{"gel.curvature": [80.0, 80.0]}'))
    with pytest.raises(InvalidArgumentError, match="units='tacsl' holds no forces"):
        main(Args(tactile='{"units": "tacsl"}', report=tmp_path / "sensor.html"))


def test_value_that_is_no_number_breaks_a_bound():
    assert not Check("", float("nan"), 1.0, "").holds
    assert not Check("", float("nan"), 1.0, "", at_least=True).holds
    assert Check("", 0.95, 0.9, "", at_least=True).holds
    assert Check("", 1e9, None, "mm").holds  # a known limit is not judged


def test_a_reading_that_is_no_number_breaks_its_bound_wherever_it_is():
    load = np.array([1.0, 0.0, 0.0, 0.0])
    readings = [Reading("ball, 10 mm", load, load, load, 0.0, 1.0) for _ in range(3)]
    readings[1] = replace(readings[1], reported=load * np.nan, centre_error=np.nan)
    loop = np.array([(0, 0), (5, 5), (10, 10), (5, 5), (0, 0)], float)
    found = Measurements(readings, [], loop, np.array([(1.0, 1e-4, 1e-4)]))
    checks = checks_of(found, task_sensor("digit", "a", "b", {}, {}))
    assert [check.holds for check in checks] == [False] * 5 + [True] * 2


@pytest.mark.parametrize("entry", range(4))
def test_one_bad_reading_among_good_ones_breaks_its_bound(entry):
    load = np.array([10.0, 1.0, -2.0, 0.01])
    good = Reading("ball, 10 mm", load, load, load, 0.0, 1.0)
    off = np.zeros(4)
    off[entry] = 0.0075 if entry == 3 else 0.15  # 0.75 mm, or 1.5 % of the normal load
    loop = np.array([(0, 0), (10, 10), (0, 0)], float)
    for bad, holds in ((load + 0.5 * off, True), (load + off, False), (load - off, False)):
        readings = [good, replace(good, reported=bad), good]
        found = Measurements(readings, [], loop, np.array([(1.0, 1e-4, 1e-4)]))
        checks = checks_of(found, task_sensor("digit", "a", "b", {}, {}))
        assert all(check.holds for check in checks) is holds


def test_area_of_a_loop():
    loop = np.array([(0, 0), (5, 5), (10, 10), (5, 7), (0, 0)], float)
    assert loop_area(loop) == pytest.approx((0.5 * 10 * 2) / 50)


@pytest.mark.parametrize(("curvature", "radius"), [(0.0, 0.01), (20.0, 0.01)])
def test_depth_of_a_ball_by_the_law_of_the_layer(curvature, radius):
    gel = GelConfig(curvature=(curvature, curvature))
    both = 1 / (1 / radius + curvature)  # m, of a ball that leaves the same gap over a flat face
    load = np.pi * gel.normal_stiffness * both * 5e-4**2
    assert ball_depth(gel, radius, load) == pytest.approx(5e-4, rel=0.02)


def test_depth_of_a_ball_in_a_gel_that_is_too_soft_to_stop_it_halfway():
    gel, radius = GelConfig(youngs_modulus=2e4), 0.01
    load = 2 / 3 * np.pi * gel.normal_stiffness * radius**3  # of a ball that is in up to its equator
    assert ball_depth(gel, radius, load) == pytest.approx(radius, rel=0.01)
    assert ball_depth(gel, radius, 2 * load) > radius
