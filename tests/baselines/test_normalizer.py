"""The ranges to which observations and actions are mapped."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from baselines.common.normalizer import ActionNormalizer, Normalizer


def test_normalizer_maps_the_datas_range_and_back():
    data = torch.tensor([[0.0, 5.0, 2.0], [10.0, 7.0, 2.0]])
    normalizer = Normalizer(3)
    normalizer.fit(data)
    assert normalizer.normalize(data)[:, :2].tolist() == [[-1, -1], [1, 1]]
    assert torch.allclose(normalizer.restore(normalizer.normalize(data)), data)
    assert normalizer.normalize(data)[:, 2].abs().max() == 0  # what never moved stays small


@pytest.mark.parametrize(
    ("low", "high", "limit"), [(-1.0, 1.0, 1.0), (-0.2, 0.5, 1.0), (-3.0, 0.5, torch.inf), (0.0, 1.5, torch.inf)]
)
def test_actions_are_limited_to_1_unless_demonstrations_go_beyond_on_either_side(low, high, limit):
    normalizer = ActionNormalizer(2)
    normalizer.fit(torch.tensor([[low, 0.0], [high, 0.1]]))
    assert normalizer.limit == limit


@pytest.mark.parametrize("pairs", [[], [(0, 1), (3, 4)]])
def test_small_actions_have_more_room_on_the_root_scale(pairs):
    actions = torch.cat([torch.rand(100, 6) * 2 - 1, torch.eye(6), -torch.eye(6), torch.zeros(1, 6)])
    linear, root = ActionNormalizer(6), ActionNormalizer(6, root=True, pairs=pairs)
    for normalizer in (linear, root):
        normalizer.fit(actions)
        assert torch.allclose(normalizer.restore(normalizer.normalize(actions)), actions, atol=1e-6)
        assert normalizer.normalize(actions).abs().max() <= 1 + 1e-6
    slide = 0.04 * torch.eye(6)
    assert torch.allclose(linear.normalize(slide).diagonal(), torch.full((6,), 0.04), atol=0.02)
    assert torch.allclose(root.normalize(slide).diagonal(), torch.full((6,), 0.2), atol=0.02)


def test_the_root_of_a_vector_turns_as_the_vector_does():
    turn = torch.as_tensor(Rotation.from_euler("z", 0.7).as_matrix(), dtype=torch.float32)
    actions = torch.rand(50, 6) * 2 - 1
    turned = torch.cat([actions[:, :3] @ turn.T, actions[:, 3:] @ turn.T], dim=1)
    normalizer = ActionNormalizer(6, root=True, pairs=[(0, 1), (3, 4)])  # its range is [-1, 1] before it is fitted
    expected = normalizer.normalize(actions)
    expected = torch.cat([expected[:, :3] @ turn.T, expected[:, 3:] @ turn.T], dim=1)
    assert torch.allclose(normalizer.normalize(turned), expected, atol=1e-6)


def test_force_fields_are_normalised_taxel_by_taxel():
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([[1.0, 0.1], [0.01, 0.0]])[None, ..., None]  # N, of four taxels: a corner, two inside, one untouched
    fields = size * torch.rand(50, 2, 2, 3, generator=generator)
    normalizer = Normalizer.of_taxels((2, 2))
    normalizer.fit(fields)
    seen = normalizer.normalize(fields)
    assert seen[:, 0].amax((0, 1)).tolist() == pytest.approx([1, 1, 1])
    assert seen[:, 0, 1].std(0).min() > 0.4  # a tenth of the corner's force is seen as large as that
    assert 0.1 < seen[:, 1, 0].abs().max() < 0.3  # less than a twentieth is not magnified as far
    assert (seen[:, 1, 1] == 0).all()
    assert torch.allclose(normalizer.restore(seen), fields, atol=1e-6)


def test_shear_that_is_small_beside_the_normal_force_fills_the_range_too():
    fields = torch.tensor([10.0, 0.1, 0.1]) * torch.rand(50, 3, 4, 3, generator=torch.Generator().manual_seed(0))  # N
    normalizer = Normalizer.of_taxels((3, 4))
    normalizer.fit(fields)
    assert normalizer.normalize(fields).abs().amax((0, 1, 2)).tolist() == pytest.approx([1.0] * 3)


def test_touch_in_the_papers_units_fills_the_range_too():
    fields = 1e-4 * torch.rand(50, 3, 4, 3, generator=torch.Generator().manual_seed(0))  # m
    normalizer = Normalizer.of_taxels((3, 4))
    normalizer.fit(fields)
    assert normalizer.normalize(fields).abs().amax((0, 3)).min().item() == pytest.approx(1.0)
