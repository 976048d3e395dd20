"""How near simulated touch is to real.

    python -m manifeel_ms3.analysis.sim_real_similarity --sim trajectory.h5 --real DIR --features inception

Two sets of tactile pictures are told apart by the features of a network that was trained on photographs: FID is the Fréchet
distance of the normal distributions nearest to theirs (Heusel et al. 2017), KID the squared maximum mean discrepancy under a
cubic kernel (Binkowski et al. 2018, unbiased). Both depend on the features, so which are used is always asked and told.
"""

import logging
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import tyro
from scipy import linalg

from manifeel_ms3.command_line import run
from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories
from manifeel_ms3.evaluation.policy import import_name
from manifeel_ms3.files import write_json
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.sensors.visualisation import force_field_images

from .protocol import Estimate

log = logging.getLogger(__name__)
Features = Callable[[np.ndarray], np.ndarray]
Distance = Callable[[np.ndarray, np.ndarray], float]
PICTURES, FIELDS, RECORDINGS = (".png", ".jpg", ".jpeg"), (".npy", ".npz"), (".h5",)
BATCH = 32
FEWEST = 10  # pictures a side
PAIRS = 8  # shown
CONTACT = 0.05  # N: a recorded field of less is not of a contact


class SimilarityError(ValueError):
    """Pictures or features that cannot be used."""


@dataclass
class Args:
    sim: Path
    """folder of pictures (TacRGB: png, jpg) or force fields (TacFF: npy or npz of (10, 14, 3), N), or a trajectory file"""
    real: Path
    """the same, of the real sensor"""
    features: str
    """"inception" (FID's own; needs the extra `similarity`), a ResNet of transformers ("microsoft/resnet-18", or a folder),
    or a function of your own, "module:function", from (N, H, W, 3) uint8 to (N, D)"""
    modality: str = "tacrgb"
    """"tacrgb" or "tacff": what is taken from trajectory files"""
    pad: str = "tactile_right"
    """of trajectory files"""
    limit: int = 2000
    """pictures a side, drawn at random from what there is"""
    resamples: int = 100
    """of the bootstrap"""
    out: Path = Path("runs/similarity")
    """folder for similarity.json and nearest.png"""


@dataclass(frozen=True)
class Similarity:
    """Distances, with intervals of 95 % from a bootstrap over pictures."""

    fid: Estimate
    kid: Estimate
    features: str
    dimensions: int
    sim_count: int
    real_count: int


def main(args: Args) -> Similarity:
    """Compare, and write similarity.json and nearest.png.

    Raises:
        SimilarityError: a folder has too few pictures, one is broken, or the features cannot be had.
    """
    sim, real = (pictures_of(folder, args) for folder in (args.sim, args.real))
    extract = features_by_name(args.features)
    with progress_bar() as bar:
        task = bar.add_task("features", total=len(sim) + len(real))
        sides = []
        for pictures in (sim, real):
            parts = []
            for k in range(0, len(pictures), BATCH):
                parts.append(np.asarray(extract(np.stack(pictures[k : k + BATCH])), np.float64))
                bar.advance(task, len(parts[-1]))
            sides.append(np.concatenate(parts))
    told, true = sides
    result = Similarity(
        bootstrapped(fid, told, true, args.resamples),
        bootstrapped(kid, told, true, args.resamples),
        args.features,
        told.shape[1],
        len(told),
        len(true),
    )
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(args.out / "similarity.json", asdict(result))
    cv2.imwrite(str(args.out / "nearest.png"), nearest_pairs(sim, real, told, true)[..., ::-1])
    for name, found in (("FID", result.fid), ("KID", result.kid)):
        log.info("%s %.4g [%.4g, %.4g]", name, found.value, found.low, found.high)
    log.info("features %s (%d), %d simulated, %d real", args.features, result.dimensions, len(told), len(true))
    return result


# -------------------------------------------------------------------- distances


def fid(sim: np.ndarray, real: np.ndarray) -> float:
    """Fréchet distance of normal distributions with the means and covariances of features (N, D) and (M, D)."""
    gap = sim.mean(0) - real.mean(0)
    # R of a side's deviations is a root of its covariance, R'R; tr (R'R S'S)^1/2 is the sum of the singular values of R S'
    roots = [np.linalg.qr((side - side.mean(0)) / np.sqrt(len(side) - 1), mode="r") for side in (sim, real)]
    spread = sum((root**2).sum() for root in roots)
    return float(gap @ gap + spread - 2 * linalg.svdvals(roots[0] @ roots[1].T).sum())


def kid(sim: np.ndarray, real: np.ndarray) -> float:
    """Squared maximum mean discrepancy of features (N, D) and (M, D) under the kernel (x y / D + 1)^3, unbiased."""

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a @ b.T / a.shape[1] + 1) ** 3

    def within(side: np.ndarray) -> float:
        values = kernel(side, side)
        return (values.sum() - np.trace(values)) / (len(side) * (len(side) - 1))

    return float(within(sim) + within(real) - 2 * kernel(sim, real).mean())


def bootstrapped(distance: Distance, sim: np.ndarray, real: np.ndarray, resamples: int) -> Estimate:
    """A distance; its interval from halves of both sides, drawn without repeats (which would look like modes of their own)."""
    rng = np.random.default_rng(0)

    def half(side: np.ndarray) -> np.ndarray:
        return side[rng.choice(len(side), len(side) // 2, replace=False)]

    value = distance(sim, real)
    drawn = np.array([distance(half(sim), half(real)) for _ in range(resamples)])
    low, high = np.quantile(drawn - drawn.mean(), [0.025, 0.975])  # halves of a sample vary as samples do
    return Estimate(value, value + float(low), value + float(high))


# -------------------------------------------------------------------- pictures


def pictures_of(source: Path, args: Args) -> list[np.ndarray]:
    """Pictures (H, W, 3) uint8 of a folder or trajectory file, all of one size; force fields drawn as they are for people.

    Raises:
        SimilarityError: there are too few, or one is broken.
    """
    if source.suffix in RECORDINGS:
        found = _recorded(source, args)
    else:
        files = sorted(path for path in source.rglob("*") if path.suffix.lower() in PICTURES + FIELDS)
        if len(files) > args.limit:
            files = [files[k] for k in np.random.default_rng(0).choice(len(files), args.limit, replace=False)]
        found = [_picture(path) for path in files]
    if len(found) < FEWEST:
        raise SimilarityError(f"{source} holds {len(found)} of {PICTURES + FIELDS}; at least {FEWEST} are needed")
    height, width = found[0].shape[:2]
    return [cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA) for picture in found]


def _picture(path: Path) -> np.ndarray:
    if path.suffix.lower() in PICTURES:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is None:
            raise SimilarityError(f"{path} cannot be read as a picture; mend it or take it out")
        return picture[..., ::-1]
    loaded = np.load(path)
    field = loaded if isinstance(loaded, np.ndarray) else loaded[loaded.files[0]]
    if field.ndim != 3 or field.shape[-1] != 3:
        raise SimilarityError(f"{path} holds an array {field.shape}; a force field is (rows, columns, 3), in N")
    return _drawn(field)


def _drawn(field: np.ndarray) -> np.ndarray:
    return force_field_images(torch.as_tensor(field, dtype=torch.float32)[None])[0].cpu().numpy()


def _recorded(path: Path, args: Args) -> list[np.ndarray]:
    """What a pad saw of contacts, at random moments."""
    kind = "rgb" if args.modality == "tacrgb" else "force_field"
    with open_trajectories(path) as file:
        seen: dict[Any, Any] = {name: file[name].get(f"obs/sensor_data/{args.pad}", {}) for name in file}
        if not all("force_field" in pad and kind in pad for pad in seen.values()):
            raise SimilarityError(f"{path} lacks {args.modality} of {args.pad}; record it with --obs-mode tacrgb+tacff")
        touched = [
            (name, int(t))
            for name, pad in seen.items()
            for t in np.flatnonzero(np.abs(pad["force_field"][()]).sum((1, 2, 3)) > CONTACT)
        ]
        chosen = sorted(np.random.default_rng(0).permutation(len(touched))[: args.limit])
        found = [seen[name][kind][t] for name, t in (touched[k] for k in chosen)]
    return found if kind == "rgb" else [_drawn(field) for field in found]


def nearest_pairs(sim: list[np.ndarray], real: list[np.ndarray], told: np.ndarray, true: np.ndarray) -> np.ndarray:
    """A picture: above, some real ones; below, the simulated one nearest to each in features (N, D) and (M, D)."""
    chosen = np.linspace(0, len(real) - 1, min(PAIRS, len(real))).round().astype(int)
    nearest = [int(np.linalg.norm(told - true[k], axis=1).argmin()) for k in chosen]

    def row(pictures: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([cv2.resize(picture, (160, 160), interpolation=cv2.INTER_AREA) for picture in pictures], axis=1)

    return np.concatenate([row([real[k] for k in chosen]), row([sim[k] for k in nearest])])


# -------------------------------------------------------------------- features


def features_by_name(name: str) -> Features:
    """What makes features (N, D) of pictures (N, H, W, 3) uint8. Never another than was asked for.

    Raises:
        SimilarityError: it cannot be had.
    """
    if name == "inception":
        return _inception()
    if ":" in name:
        return import_name(name)
    return _resnet(name)


def _inception() -> Features:
    try:
        from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3  # pyright: ignore

        network = FeatureExtractorInceptionV3("inception", ["2048"])
    except (ImportError, OSError) as error:
        raise SimilarityError(
            f"FID's Inception network cannot be had ({error}); `pip install manifeel_ms3[similarity]` (it is then downloaded), "
            'or choose other --features: a ResNet such as "microsoft/resnet-18", or "module:function"'
        ) from error

    @torch.inference_mode()
    def extract(pictures: np.ndarray) -> np.ndarray:
        return network(torch.as_tensor(pictures.copy()).movedim(-1, 1))[0].numpy()

    return extract


def _resnet(name: str) -> Features:
    from transformers import AutoImageProcessor, ResNetModel

    try:
        processor, network = AutoImageProcessor.from_pretrained(name), ResNetModel.from_pretrained(name)
    except (OSError, ValueError) as error:
        raise SimilarityError(
            f"{name} cannot be had as a ResNet ({error}); give the name of one that can be downloaded, its folder, "
            '"inception", or a function of your own, "module:function"'
        ) from error
    network.eval()

    @torch.inference_mode()
    def extract(pictures: np.ndarray) -> np.ndarray:
        inputs = processor(list(pictures), return_tensors="pt")
        return network(**inputs).pooler_output.flatten(1).numpy()

    return extract


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
