"""Makes the compact copy of Taxim's R1.5 calibration in `data`: `python -m tests.sensors.make_calibration POLYCALIB`.

POLYCALIB is the R1.5's `polycalib.npz` of Taxim's code (MIT License, see NOTICE). Only what the tests read is kept: the slope
bins up to 1.2 rad, in int16 relative to the greatest coefficient of each term. Colours change by 0.01 grey levels at most.
"""

import sys
from pathlib import Path

import numpy as np

from manifeel_ms3.sensors.optics.taxim_table import TABLE_CHANNELS, read_table
from manifeel_ms3.verification.published_colours import CALIBRATION, published_table

MAX_SLOPE = 1.2  # rad, above all slopes that the tests press or fit


def subset(table: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of the compact file."""
    bins = table.shape[1]
    kept = int(MAX_SLOPE / (np.pi / 2 / (bins - 1))) + 1
    scale = np.abs(table[:, :kept]).max(axis=(0, 1, 2)) / np.iinfo(np.int16).max
    return {"coefficients": np.rint(table[:, :kept] / scale).astype(np.int16), "scale": scale, "bins": np.array(bins)}


def write_table(path: Path) -> Path:
    """Write the compact copy as a table in Taxim's format."""
    np.savez(path, **dict(zip(TABLE_CHANNELS, published_table(), strict=True)))
    return path


if __name__ == "__main__":
    np.savez_compressed(CALIBRATION, **subset(read_table(Path(sys.argv[1]))))
