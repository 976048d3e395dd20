"""Measure how near simulated touch is to real touch.

    manifeel similarity --sim peg.h5 --real DIR --features inception

Two sets of tactile images are compared by the features of a network that was trained on photographs. FID is the Fréchet
distance between the normal distributions that fit the two sets of features (Heusel et al. 2017), KID the squared maximum mean
discrepancy under a cubic kernel (Binkowski et al. 2018, unbiased). Both depend on the features, so they must always be given,
and the result names them.
"""

import logging
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
import tyro
from scipy import linalg

from manifeel_ms3.arguments import require_positive
from manifeel_ms3.command_line import as_typed, missing_extras_named, run
from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories, read_header
from manifeel_ms3.demonstrations.formats.touch_units import recorded_sensor
from manifeel_ms3.errors import InvalidArgumentError, InvalidFileError
from manifeel_ms3.evaluation.policy import import_name
from manifeel_ms3.files import NOT_NPZ, atomic_write, read_npz, write_json
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.sensors.imperfection_config import FULL_SCALE_FORCE
from manifeel_ms3.sensors.visualisation import force_field_images

from .estimates import TAILS, Estimate

log = logging.getLogger(__name__)
Features = Callable[[np.ndarray], np.ndarray]
Distance = Callable[[np.ndarray, np.ndarray], float]
IMAGES, FIELDS, RECORDINGS = (".png", ".jpg", ".jpeg"), (".npy", ".npz"), (".h5",)
"""Suffixes of files with an image, a force field, or recorded episodes."""
BATCH = 32
"""Number of images that a network takes at once; set once, not tuned."""
FEWEST = 10
"""Smallest number of images in each set; set once, not tuned."""
PAIRS, PAIR_SIDE = 8, 160
"""Number of pairs in nearest.png, and the width and height of an image there, in pixels."""
IN_CONTACT = 0.05
"""Sum of the absolute forces of a recorded field, in N, above which the pad counts as in contact; set once, not tuned."""
INCEPTION_FEATURES = "2048"
"""Name that torch-fidelity gives to the features which FID is defined on: the 2048 after Inception's last pooling."""


class SimilarityError(InvalidArgumentError):
    """Images or features cannot be used."""


@dataclass
class Args:
    """Arguments of the comparison."""

    sim: Path
    """Simulated touch: a folder of images (TacRGB: png, jpg) or force fields (TacFF: npy or npz of (10, 14, 3), N), or a
    trajectory file."""
    real: Path
    """Real touch, in one of the same forms."""
    features: str
    """Features that images are compared by: "inception" (FID's own; needs the extra `similarity`), a ResNet of transformers
    ("microsoft/resnet-18", or a folder), or your own function ("module:function") from (N, H, W, 3) uint8 to (N, D)."""
    modality: Literal["tacrgb", "tacff"] = "tacrgb"
    """Modality that is read from trajectory files and folders: "tacrgb" (images) or "tacff" (force fields)."""
    pad: Literal["tactile_left", "tactile_right"] = "tactile_right"
    """Finger pad that is read from trajectory files: "tactile_left" or "tactile_right"."""
    limit: int = 2000
    """Largest number of images in each set; if there are more, this number is drawn at random."""
    resamples: int = 100
    """Number of resamples of the bootstrap."""
    out: Path = Path("runs/similarity")
    """Folder for similarity.json and nearest.png."""
    object: str = ""
    """Object that both sensors touch; for "ball", "bulb" or "gear", the page of results shows the distances beside the
    paper's."""


@dataclass(frozen=True)
class Similarity:
    """Distances between simulated and real touch, with intervals of 95 % from a bootstrap over images."""

    fid: Estimate
    """Fréchet distance of the features."""
    kid: Estimate
    """Squared maximum mean discrepancy of the features."""
    modality: str
    """Modality, "tacrgb" or "tacff"."""
    object: str
    """Object that both sensors touch; "" if it was not named."""
    features: str
    """Name of the features, as it was given."""
    dimensions: int
    """Number of features of an image."""
    sim_count: int
    """Number of simulated images."""
    real_count: int
    """Number of real images."""


def main(args: Args) -> Similarity:
    """Compare two sets of images, and write similarity.json and nearest.png.

    Raises:
        SimilarityError: A set has too few images, one is broken, or the features are not available.
        InvalidArgumentError: A number is too small.
        MissingExtraError: An extra that the features need is not installed.
    """
    require_positive(limit=args.limit, resamples=args.resamples)
    if args.limit < FEWEST:
        raise InvalidArgumentError(
            f"--limit {args.limit} is too small; a comparison needs at least {FEWEST} images of each set"
        )
    sim_images, real_images = (images_of(folder, args) for folder in (args.sim, args.real))
    sim, real = _features_of([sim_images, real_images], features_by_name(args.features))
    result = Similarity(
        bootstrapped(fid, sim, real, args.resamples, least=0.0),
        bootstrapped(kid, sim, real, args.resamples),
        args.modality,
        args.object,
        args.features,
        sim.shape[1],
        len(sim),
        len(real),
    )
    write_json(args.out / "similarity.json", asdict(result))
    with atomic_write(args.out / "nearest.png") as partial:
        pairs = nearest_pairs(sim_images, real_images, sim, real)[..., ::-1]
        partial.write_bytes(cv2.imencode(".png", pairs)[1].tobytes())
    for name, found in (("FID", result.fid), ("KID", result.kid)):
        log.info("%s %.4g [%.4g, %.4g]", name, found.value, found.low, found.high)
    log.info("features %s (%d), %d simulated, %d real", args.features, result.dimensions, len(sim), len(real))
    return result


def _features_of(sets: list[list[np.ndarray]], extract: Features) -> list[np.ndarray]:
    """Features (N, D) of each set of images.

    Raises:
        SimilarityError: The function gives something else than finite numbers (N, D), or another D for each side.
    """
    features = []
    with progress_bar() as bar:
        task = bar.add_task("features", total=sum(map(len, sets)))
        for images in sets:
            parts = []
            for k in range(0, len(images), BATCH):
                batch = np.stack(images[k : k + BATCH])
                part = np.asarray(extract(batch), np.float64)
                if part.ndim != 2 or len(part) != len(batch) or not np.isfinite(part).all():
                    raise SimilarityError(
                        f"--features makes an array {part.shape} of {batch.shape[0]} images, or numbers that are not finite; "
                        "a function of your own must return finite numbers (N, D) for N images"
                    )
                parts.append(part)
                bar.advance(task, len(part))
            features.append(np.concatenate(parts))
    if len(sizes := sorted({side.shape[1] for side in features})) > 1:
        raise SimilarityError(
            f"--features makes {sizes} features for the images of the two sides; it must make "
            "equally many for images of every size"
        )
    return features


# -------------------------------------------------------------------- distances


def fid(sim: np.ndarray, real: np.ndarray) -> float:
    """Fréchet distance of normal distributions with the means and covariances of features (N, D) and (M, D)."""
    gap = sim.mean(0) - real.mean(0)
    # R of the QR decomposition is a root of a covariance, R'R; tr (R'R S'S)^1/2 is the sum of the singular values of R S'
    roots: list[Any] = [np.linalg.qr((side - side.mean(0)) / np.sqrt(len(side) - 1), mode="r") for side in (sim, real)]
    spread = sum((root**2).sum() for root in roots)
    singular_values = np.asarray(linalg.svdvals(roots[0] @ roots[1].T))
    return float(gap @ gap + spread - 2 * singular_values.sum())


def kid(sim: np.ndarray, real: np.ndarray) -> float:
    """Squared maximum mean discrepancy of features (N, D) and (M, D) under the kernel (x y / D + 1)^3, unbiased."""

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a @ b.T / a.shape[1] + 1) ** 3

    def within(side: np.ndarray) -> float:
        values = kernel(side, side)
        return (values.sum() - np.trace(values)) / (len(side) * (len(side) - 1))

    return float(within(sim) + within(real) - 2 * kernel(sim, real).mean())


def bootstrapped(distance: Distance, sim: np.ndarray, real: np.ndarray, resamples: int, least: float = -np.inf) -> Estimate:
    """A distance, with its interval of 95 % from halves of both sets.

    The halves are drawn without replacement, since repeated images would look like modes of their own.

    Args:
        distance: Function of the two sets of features.
        sim: Features (N, D) of simulated images.
        real: Features (M, D) of real images.
        resamples: Number of halves that are drawn.
        least: Smallest value that the distance can have, below which the interval does not reach.
    """
    rng = np.random.default_rng(0)

    def half(side: np.ndarray) -> np.ndarray:
        return side[rng.choice(len(side), len(side) // 2, replace=False)]

    value = distance(sim, real)
    drawn = np.array([distance(half(sim), half(real)) for _ in range(resamples)])
    low, high = np.quantile(drawn - drawn.mean(), TAILS)  # halves of a sample vary as samples do
    return Estimate(value, max(value + float(low), least), value + float(high))


# -------------------------------------------------------------------- images


def images_of(source: Path, args: Args) -> list[np.ndarray]:
    """Images (H, W, 3) uint8 of a folder or trajectory file, all of one size.

    Force fields become images in the way that they are drawn for people.

    Raises:
        SimilarityError: There are too few images, or one is broken.
    """
    suffixes = IMAGES if args.modality == "tacrgb" else FIELDS
    if source.suffix in RECORDINGS:
        found, kind = _recorded(source, args), f"moments at which the {args.pad} pad is in contact"
    else:
        if not source.is_dir():
            raise SimilarityError(f"{source} is no folder; give a folder of images or force fields, or a trajectory file")
        files = sorted(path for path in source.rglob("*") if path.suffix.lower() in suffixes)
        if len(files) > args.limit:
            files = [files[k] for k in np.random.default_rng(0).choice(len(files), args.limit, replace=False)]
        found, kind = [_image(path) for path in files], f"of {suffixes}"
    if len(found) < FEWEST:
        raise SimilarityError(f"{source} holds {len(found)} {kind}; --modality {args.modality} needs at least {FEWEST} of them")
    height, width = found[0].shape[:2]
    return [cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in found]


def _image(path: Path) -> np.ndarray:
    if path.suffix.lower() in IMAGES:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise SimilarityError(f"{path} cannot be read as an image; repair or remove it")
        return image[..., ::-1]
    try:
        if path.suffix.lower() == ".npz":
            field = next(iter(read_npz(path, "a force field").values()), np.zeros(0))
        else:
            field = np.load(path)
            if not isinstance(field, np.ndarray):
                raise ValueError("it is an archive of arrays; name it .npz")
    except (*NOT_NPZ, InvalidFileError) as error:
        raise SimilarityError(f"{path} cannot be read as a force field ({error}); repair or remove it") from error
    is_finite = field.dtype.kind in "fiu" and bool(np.isfinite(field).all())
    if field.ndim != 3 or field.shape[-1] != 3 or field.size == 0 or not is_finite:
        raise SimilarityError(
            f"{path} holds an array {field.shape} of {field.dtype}; a force field is (rows, columns, 3) finite numbers, in N"
        )
    return _drawn(field)


def _drawn(field: np.ndarray) -> np.ndarray:
    return force_field_images(torch.as_tensor(field, dtype=torch.float32)[None], FULL_SCALE_FORCE)[0].cpu().numpy()


def _recorded(path: Path, args: Args) -> list[np.ndarray]:
    """Images of a pad in contact, at random moments."""
    kind = "rgb" if args.modality == "tacrgb" else "force_field"
    units = recorded_sensor(read_header(path)["env_info"]["env_kwargs"], args.pad).units
    if units != "newton":
        raise SimilarityError(f"{path} holds force fields in the units {units!r} and not in N; record it without that option")
    with open_trajectories(path) as file:
        episodes: dict[str, Any] = dict(file.items())
        pads = {name: episode.get(f"obs/sensor_data/{args.pad}", {}) for name, episode in episodes.items()}
        if not all("force_field" in pad and kind in pad for pad in pads.values()):
            raise SimilarityError(f"{path} lacks {args.modality} of {args.pad}; record it with --obs-mode tacrgb+tacff")
        touched = [
            (name, int(t))
            for name, pad in pads.items()
            for t in np.flatnonzero(np.abs(pad["force_field"][()]).sum((1, 2, 3)) > IN_CONTACT)
        ]
        chosen = sorted(np.random.default_rng(0).permutation(len(touched))[: args.limit])
        found = [pads[name][kind][t] for name, t in (touched[k] for k in chosen)]
    return found if kind == "rgb" else [_drawn(field) for field in found]


def nearest_pairs(sim_images: list[np.ndarray], real_images: list[np.ndarray], sim: np.ndarray, real: np.ndarray) -> np.ndarray:
    """An image with some real images above, and the simulated image nearest to each of them below.

    Args:
        sim_images: Simulated images.
        real_images: Real images.
        sim: Features (N, D) of the simulated images.
        real: Features (M, D) of the real images.
    """
    chosen = np.linspace(0, len(real_images) - 1, min(PAIRS, len(real_images))).round().astype(int)
    nearest = [int(np.linalg.norm(sim - real[k], axis=1).argmin()) for k in chosen]

    def row(images: list[np.ndarray]) -> np.ndarray:
        tiles = [cv2.resize(image, (PAIR_SIDE, PAIR_SIDE), interpolation=cv2.INTER_AREA) for image in images]
        return np.concatenate(tiles, axis=1)

    return np.concatenate([row([real_images[k] for k in chosen]), row([sim_images[k] for k in nearest])])


# -------------------------------------------------------------------- features


def features_by_name(name: str) -> Features:
    """The function that makes features (N, D) of images (N, H, W, 3) uint8; always the one that was named.

    Args:
        name: "inception", name or folder of a ResNet, or "module:function", as the command line gives it.

    Raises:
        SimilarityError: The features are not available.
        MissingExtraError: An extra that the features need is not installed.
    """
    if name == "inception":
        return _inception()
    if ":" not in name:
        return _resnet(name)
    try:
        return import_name(name)
    except (ImportError, AttributeError) as error:
        raise SimilarityError(
            f"--features {name} cannot be imported ({error}); give module:function, importable from here"
        ) from error


def _inception() -> Features:
    with missing_extras_named():
        from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3  # pyright: ignore[reportMissingImports]

    try:
        network = FeatureExtractorInceptionV3("inception", [INCEPTION_FEATURES])
    except OSError as error:
        raise SimilarityError(
            f"FID's Inception network cannot be downloaded ({error}); choose other --features: a ResNet such as "
            '"microsoft/resnet-18", or "module:function"'
        ) from error

    @torch.inference_mode()
    def extract(images: np.ndarray) -> np.ndarray:
        return network(torch.as_tensor(images.copy()).movedim(-1, 1))[0].numpy()

    return extract


def _resnet(name: str) -> Features:
    with missing_extras_named():
        from transformers import AutoImageProcessor, ResNetModel

    try:
        processor, network = AutoImageProcessor.from_pretrained(name), ResNetModel.from_pretrained(name)
    except (OSError, ValueError) as error:
        raise SimilarityError(
            f"{name} cannot be loaded as a ResNet ({error}); give the name of one that can be downloaded, its folder, "
            '"inception", or your own function, "module:function"'
        ) from error
    network.eval()

    @torch.inference_mode()
    def extract(images: np.ndarray) -> np.ndarray:
        inputs = processor(list(images), return_tensors="pt")
        return network(**inputs).pooler_output.flatten(1).numpy()

    return extract


def next_step(args: Args, _result: Similarity) -> str:
    """What the command made, and what one can do with it."""
    page = as_typed("manifeel", "results", "--results", args.out, "FOLDER", "--out", "results.md")
    made = f"{args.out} has the distances in similarity.json and the nearest images in nearest.png"
    return f"{made}; {page} sets them beside the paper's"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
