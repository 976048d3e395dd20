"""Pictures of the force field: each taxel at its place, and the shear as an arrow in its direction."""

import numpy as np
import pytest
import torch

from manifeel_ms3.sensors.visualisation import force_field_images, observation_images

FULL_SCALE, PITCH = 0.6, (24.0, 320 / 14)  # N; pixels along rows and columns of an image of 240 x 320
TAXEL = (3, 9)


def picture(normal: float, rows: float = 0.0, cols: float = 0.0) -> np.ndarray:
    field = torch.zeros(1, 10, 14, 3)
    field[(0, *TAXEL)] = torch.tensor([normal, rows, cols])
    return force_field_images(field, FULL_SCALE)[0].numpy().astype(int)


def test_a_taxel_is_as_bright_as_its_share_of_the_full_scale():
    levels = [picture(share * FULL_SCALE).sum(-1) for share in (0.0, 0.5, 1.0, 2.0)]
    where = np.argwhere(levels[2] != levels[0])
    assert where.min(0) == pytest.approx([TAXEL[0] * PITCH[0], TAXEL[1] * PITCH[1]], abs=1)
    assert where.max(0) == pytest.approx([(TAXEL[0] + 1) * PITCH[0], (TAXEL[1] + 1) * PITCH[1]], abs=1.5)
    assert levels[0].max() < levels[1].max() < levels[2].max()
    assert np.array_equal(levels[2], levels[3])


@pytest.mark.parametrize(("rows", "cols"), [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1)])
def test_a_shear_of_100_millinewtons_is_an_arrow_one_taxel_long(rows, cols):
    """From the middle of the taxel, downwards for a shear along increasing rows, to the right along increasing columns."""
    drawn = np.argwhere((picture(0.0, rows, cols) != picture(0.0)).any(-1))
    start = (np.array(TAXEL) + 0.5) * PITCH
    end = start + np.array([rows, cols]) / 0.1 * PITCH
    axis = int(rows == 0)
    assert np.sort([drawn[:, axis].min(), drawn[:, axis].max()]) == pytest.approx(np.sort([start[axis], end[axis]]), abs=2)
    assert drawn[:, 1 - axis].mean() == pytest.approx(start[1 - axis], abs=1)
    beyond_half = np.abs(drawn[:, axis] - start[axis]) > 0.5 * PITCH[axis]
    width = [np.ptp(drawn[part, 1 - axis]) for part in (beyond_half, ~beyond_half)]
    assert width[0] > width[1]  # the head is at its end


def test_images_of_an_observation_have_their_titles():
    rgb, field = torch.zeros(2, 24, 32, 3, dtype=torch.uint8), torch.zeros(2, 10, 14, 3)
    rgb[0] += 7
    field[0, ..., 0] = 0.3
    obs = dict(sensor_data=dict(wrist=dict(rgb=rgb), tactile_left=dict(rgb=rgb, force_field=field)))
    images = observation_images(obs, dict(tactile_left=0.3))
    assert list(images) == ["wrist", "tactile left: TacRGB", "tactile left: TacFF"]
    assert (images["wrist"] == 7).all()
    bright = force_field_images(field[:1], 0.3)[0].numpy()
    assert np.array_equal(images["tactile left: TacFF"], bright)
