"""Distances between sets of tactile images, against cases whose answer is known."""

import json
import shutil
from math import comb
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import tyro
from transformers import ConvNextImageProcessor, ResNetConfig, ResNetModel

from manifeel_ms3.analysis import sim_real_similarity
from manifeel_ms3.analysis.sim_real_similarity import Args, SimilarityError, fid, kid
from manifeel_ms3.errors import InvalidArgumentError, MissingExtraError
from tests.sample import observed_sample

RNG = np.random.default_rng(0)
OWN = "tests.analysis.test_sim_real_similarity:brightness"


def brightness(images: np.ndarray) -> np.ndarray:
    """Features of a user's own: the mean of each colour."""
    return images.mean((1, 2))


def unflattened(images: np.ndarray) -> np.ndarray:
    return images


def of_one_image(images: np.ndarray) -> np.ndarray:
    return brightness(images[:1])


def not_finite(images: np.ndarray) -> np.ndarray:
    return np.full((len(images), 3), np.inf)


def test_fid_of_normal_distributions_is_the_closed_form():
    """|m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^1/2); with diagonal covariances the last is the sum of (s1 - s2)^2."""
    first, second = (RNG.standard_normal((200_000, 4)) * scale + shift for scale, shift in ((1.0, 0.0), ([1, 2, 3, 0.5], 0.3)))
    assert fid(first, second) == pytest.approx(4 * 0.3**2 + 1 + 4 + 0.25, rel=0.01)
    assert fid(first, first[::-1]) == pytest.approx(0, abs=1e-6)


def test_kid_of_normal_distributions_is_the_closed_form():
    """E k(x, y) for k = (x y + 1)^3 in one dimension, from the moments of N(0, 1) and N(m, 1)."""
    m = 0.7
    moments = {0.0: (1, 0, 1, 0), m: (1, m, 1 + m**2, 3 * m + m**3)}

    def mean_kernel(a: float, b: float) -> float:
        return sum(comb(3, k) * moments[a][k] * moments[b][k] for k in range(4))

    expected = mean_kernel(0.0, 0.0) + mean_kernel(m, m) - 2 * mean_kernel(0.0, m)
    measured = [kid(RNG.standard_normal((1500, 1)), RNG.standard_normal((1500, 1)) + m) for _ in range(20)]
    assert np.mean(measured) == pytest.approx(expected, abs=3 * np.std(measured) / np.sqrt(len(measured)))
    none = [kid(RNG.standard_normal((300, 1)), RNG.standard_normal((300, 1))) for _ in range(100)]  # unbiased: 0, on average
    assert np.mean(none) == pytest.approx(0, abs=3 * np.std(none) / 10)


def test_the_interval_covers_what_is_true():
    """Of 40 pairs of samples, about 38 intervals of the mean's distance hold the true one."""

    def gap(sim, real):
        return float(sim.mean() - real.mean())

    found = [
        sim_real_similarity.bootstrapped(gap, RNG.normal(1, 1, (120, 1)), RNG.normal(0, 1, (80, 1)), 200) for _ in range(40)
    ]
    assert sum(estimate.low <= 1 <= estimate.high for estimate in found) >= 34


@pytest.fixture
def folders(tmp_path):
    """Images that differ by 20 grey levels, and fields."""
    for side, level in (("sim", 100), ("real", 120)):
        (tmp_path / side).mkdir()
        (tmp_path / f"{side}_fields").mkdir()
        for k in range(12):
            cv2.imwrite(str(tmp_path / side / f"{k}.png"), RNG.integers(level - 5, level + 6, (48, 64, 3)))
            np.save(tmp_path / f"{side}_fields/{k}.npy", RNG.uniform(0, level / 1000, (10, 14, 3)).astype(np.float32))
    return tmp_path


def test_folders_are_compared_and_pairs_shown(folders):
    out = folders / "out"
    result = sim_real_similarity.main(Args(folders / "sim", folders / "real", features=OWN, resamples=20, out=out))
    assert result.fid.value == pytest.approx(3 * 20**2, rel=0.05)
    assert result.fid.low < result.fid.value < result.fid.high
    written = json.loads((out / "similarity.json").read_text())
    assert (written["features"], written["dimensions"], written["sim_count"], written["real_count"]) == (OWN, 3, 12, 12)
    assert cv2.imread(str(out / "nearest.png")).shape == (320, 8 * 160, 3)


def test_force_fields_and_recordings_are_compared(folders):
    fields = sim_real_similarity.main(
        Args(folders / "sim_fields", folders / "real_fields", OWN, "tacff", resamples=5, out=folders / "out")
    )
    assert fields.fid.value > 0
    recording = observed_sample("ManiFeel-PegInsertion-v1")
    same = sim_real_similarity.main(Args(recording, recording, OWN, "tacff", resamples=5, out=folders / "out"))
    assert same.fid.value == pytest.approx(0, abs=1e-6)
    with pytest.raises(SimilarityError, match="lacks tacrgb of tactile_left"):
        sim_real_similarity.main(Args(recording, recording, OWN, "tacrgb", "tactile_left", out=folders / "out"))


def test_a_modality_or_a_number_that_is_not_allowed_is_refused(folders, capsys):
    given = ["--sim", str(folders / "sim"), "--real", str(folders / "real"), "--features", OWN]
    with pytest.raises(SystemExit):  # and not compared as if it were a force field
        tyro.cli(Args, args=[*given, "--modality", "tacrbg"])
    assert "tacrgb" in capsys.readouterr().err
    with pytest.raises(SystemExit):  # and not refused as if the recording had no touch
        tyro.cli(Args, args=[*given, "--pad", "right"])
    assert "tactile_right" in capsys.readouterr().err
    for name in ("limit", "resamples"):
        with pytest.raises(InvalidArgumentError, match=f"--{name} 0 must be at least 1"):
            sim_real_similarity.main(tyro.cli(Args, args=[*given, f"--{name}", "0"]))


def test_a_recording_in_other_units_than_newtons_is_refused(tmp_path, folders):
    recording = observed_sample("ManiFeel-PegInsertion-v1")
    other = Path(shutil.copy(recording, tmp_path / "trajectory.h5"))
    header = json.loads(recording.with_suffix(".json").read_text())
    header["env_info"]["env_kwargs"]["tactile"] = {"units": "tacsl"}
    other.with_suffix(".json").write_text(json.dumps(header))
    with pytest.raises(SimilarityError, match="units 'tacsl' and not in N"):
        sim_real_similarity.main(Args(other, folders / "real_fields", OWN, "tacff", out=folders / "out"))


def test_a_resnet_from_a_folder(folders):
    config = ResNetConfig(embedding_size=8, hidden_sizes=[8, 16], depths=[1, 1], layer_type="basic")
    ResNetModel(config).save_pretrained(folders / "resnet")
    ConvNextImageProcessor(size={"shortest_edge": 32}, crop_pct=1.0).save_pretrained(folders / "resnet")
    result = sim_real_similarity.main(
        Args(folders / "sim", folders / "real", features=str(folders / "resnet"), resamples=5, out=folders / "out")
    )
    assert result.dimensions == 16
    assert result.fid.value > 0


def test_inception_with_weights_at_hand(folders, monkeypatch):
    """The weights lie where torch keeps downloads; here they are random."""
    module = pytest.importorskip("torch_fidelity.feature_extractor_inceptionv3")
    monkeypatch.setenv("TORCH_HOME", str(folders))
    weights = folders / "hub/checkpoints" / module.URL_INCEPTION_V3.rpartition("/")[2]
    weights.parent.mkdir(parents=True)
    with monkeypatch.context() as patched:  # the network itself, which cannot be made without weights
        patched.setattr(module, "load_state_dict_from_url", lambda *_, **__: None)
        patched.setattr(module.FeatureExtractorInceptionV3, "load_state_dict", lambda *_: None)
        network = module.FeatureExtractorInceptionV3("inception", ["2048"])
    torch.save(network.state_dict(), weights)
    result = sim_real_similarity.main(Args(folders / "sim", folders / "real", "inception", resamples=2, out=folders / "out"))
    assert (result.features, result.dimensions) == ("inception", 2048)
    assert result.fid.value > 0


def of_another_number(images: np.ndarray) -> np.ndarray:
    """Features whose number depends on the size of an image."""
    return images[:, 0].reshape(len(images), -1).astype(float)


def test_features_whose_number_depends_on_the_size_of_an_image_are_refused(folders):
    for k in range(12):
        cv2.imwrite(str(folders / "real" / f"{k}.png"), np.zeros((48, 32, 3), np.uint8))
    features = OWN.replace("brightness", "of_another_number")
    with pytest.raises(SimilarityError, match=r"makes \[96, 192\] features .* equally many for images of every size"):
        sim_real_similarity.main(Args(folders / "sim", folders / "real", features, out=folders / "out"))


def test_a_distance_that_cannot_be_below_zero_has_no_interval_below_zero():
    def fid_of(least):
        return sim_real_similarity.bootstrapped(sim_real_similarity.fid, same, same, 50, least)

    same = RNG.normal(0, 1, (20, 3))
    assert fid_of(-np.inf).low < 0
    assert fid_of(0.0).low == 0
    assert fid_of(0.0).high == fid_of(-np.inf).high


@pytest.mark.parametrize(
    "field", [np.full((10, 14, 3), np.nan), np.full((10, 14, 3), "text"), np.zeros((0, 14, 3)), np.ones((10, 14, 3), complex)]
)
def test_a_field_that_is_no_force_field_is_refused(field, folders):
    np.save(folders / "real_fields/3.npy", field)
    with pytest.raises(SimilarityError, match=r"3\.npy holds an array \(\d+, 14, 3\) of .* finite numbers"):
        sim_real_similarity.main(Args(folders / "sim_fields", folders / "real_fields", OWN, "tacff", out=folders / "out"))


def test_an_archive_under_the_name_of_an_array_is_refused(folders):
    with (folders / "real_fields/3.npy").open("wb") as file:
        np.savez(file, field=np.zeros((10, 14, 3)))
    with pytest.raises(SimilarityError, match=r"3\.npy cannot be read as a force field \(it is an archive"):
        sim_real_similarity.main(Args(folders / "sim_fields", folders / "real_fields", OWN, "tacff", out=folders / "out"))


@pytest.mark.parametrize("wrong", ["unflattened", "of_one_image", "not_finite"])
def test_features_of_another_form_are_refused(folders, wrong):
    features = OWN.replace("brightness", wrong)
    with pytest.raises(SimilarityError, match=r"must return finite numbers \(N, D\) for N images"):
        sim_real_similarity.main(Args(folders / "sim", folders / "real", features, out=folders / "out"))
    assert not (folders / "out").exists()


def test_what_cannot_be_used_is_named(folders, monkeypatch):
    args = dict(out=folders / "out", resamples=2)
    with pytest.raises(SimilarityError, match="nowhere is no folder; give a folder of images"):
        sim_real_similarity.main(Args(folders / "nowhere", folders / "real", OWN, **args))
    with pytest.raises(SimilarityError, match=r"real holds 0 of .*npy.*; --modality tacff needs at least 10"):
        sim_real_similarity.main(Args(folders / "sim_fields", folders / "real", OWN, "tacff", **args))
    with pytest.raises(SimilarityError, match="cannot be loaded as a ResNet"):
        sim_real_similarity.main(Args(folders / "sim", folders / "real", str(folders / "sim"), **args))
    monkeypatch.setitem(__import__("sys").modules, "torch_fidelity.feature_extractor_inceptionv3", None)
    with pytest.raises(MissingExtraError, match=r"torch_fidelity.* is not installed: pip install 'manifeel-ms3\[similarity\]'"):
        sim_real_similarity.main(Args(folders / "sim", folders / "real", "inception", **args))
    with pytest.raises(SimilarityError, match="nowhere:nothing cannot be imported"):
        sim_real_similarity.main(Args(folders / "sim", folders / "real", "nowhere:nothing", **args))
    (folders / "sim/3.png").write_bytes(b"no picture")
    with pytest.raises(SimilarityError, match=r"3\.png cannot be read"):
        sim_real_similarity.main(Args(folders / "sim", folders / "real", OWN, **args))
    np.save(folders / "real_fields/3.npy", np.zeros((10, 14)))
    with pytest.raises(SimilarityError, match=r"3\.npy holds an array \(10, 14\)"):
        sim_real_similarity.main(Args(folders / "sim_fields", folders / "real_fields", OWN, "tacff", **args))
