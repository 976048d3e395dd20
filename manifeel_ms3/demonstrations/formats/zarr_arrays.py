"""Opening of the arrays of a zarr store from anywhere, after their metadata have passed a check.

A store can ask for decoders that run code (numcodecs' pickle), hold Python objects, and declare sizes that it does not have.
Each array's own metadata are read as json, and the array is opened by itself, so that what was checked is what zarr reads.
"""

import math
from pathlib import Path
from typing import Any

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import read_json

from .demonstration_format import MAX_COMPRESSION, DemonstrationError
from .folder_checks import broken_if_fails, stored_bytes

CHUNKS_PER_FILE = 64
"""Largest number of chunks of an array per file of the store. zarr does not store chunks that hold only zeros, but not every
array of a store is one of zeros. Set once, not tuned."""
COUNTS = {"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": 2**40}}
LENGTHS = {"type": "array", "items": {"type": "integer", "minimum": 1, "maximum": 2**40}}
"""Json schemas of an array's shape and of its chunks' shape; the upper bound is far above the length of any recording."""
CODECS = ["blosc", "gzip", "lz4", "zlib", "zstd"]
COMPRESSOR = {"type": "object", "properties": {"id": {"enum": CODECS}, "name": {"enum": CODECS}}}
"""Json schema of a compressor, of one of the kinds that run no code from the file."""
ARRAY_V2 = {
    "type": "object",
    "required": ["zarr_format", "shape", "chunks", "dtype", "compressor", "filters"],
    "properties": {
        "zarr_format": {"const": 2},
        "shape": COUNTS,
        "chunks": LENGTHS,
        "dtype": {"type": "string", "pattern": r"^(\|[biu]1|[<>]([iu][248]|f[248]))$"},
        "fill_value": {"type": ["number", "string", "boolean", "null"]},
        "compressor": {"anyOf": [{"type": "null"}, COMPRESSOR | {"required": ["id"]}]},
        "filters": {"anyOf": [{"type": "null"}, {"type": "array", "maxItems": 0}]},
    },
}
"""Json schema of an array's `.zarray`, of zarr format 2: numbers only, and no filters, of which one would unpickle objects."""
ARRAY_V3 = {
    "type": "object",
    "required": ["zarr_format", "node_type", "shape", "data_type", "chunk_grid", "codecs"],
    "properties": {
        "zarr_format": {"const": 3},
        "node_type": {"const": "array"},
        "shape": COUNTS,
        "data_type": {"type": "string", "pattern": r"^(bool|u?int(8|16|32|64)|float(16|32|64))$"},
        "chunk_grid": {
            "type": "object",
            "required": ["name", "configuration"],
            "properties": {
                "name": {"const": "regular"},
                "configuration": {"type": "object", "required": ["chunk_shape"], "properties": {"chunk_shape": LENGTHS}},
            },
        },
        "codecs": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["name"],
                "properties": {"name": {"enum": ["bytes", "blosc", "crc32c", "gzip", "zstd"]}},
            },
            "maxItems": 3,
            "contains": COMPRESSOR | {"required": ["name"]},
            "minContains": 0,
            "maxContains": 1,
        },
        "storage_transformers": {"type": "array", "maxItems": 0},
    },
}
"""Json schema of an array's `zarr.json`, of zarr format 3."""


def open_arrays(folder: Path, names: list[str]) -> dict[str, Any]:
    """Arrays of a store by their names, such as "data/action".

    Raises:
        DemonstrationError: An array is missing, holds something other than numbers, asks for a decoder that is not known to be
            harmless, or is larger than the store's files can hold; or a link leads out of the folder.
        MissingExtraError: zarr is not installed.
    """
    with missing_extras_named():
        import zarr
    files = stored_bytes(folder)
    formats = {name: _checked_format(folder, name, sum(files.values()), len(files)) for name in names}
    with broken_if_fails(folder, "the store"):
        return {name: zarr.open_array(str(folder / name), mode="r", zarr_format=formats[name]) for name in names}


def _checked_format(folder: Path, name: str, stored: int, num_files: int) -> Any:
    """The version of zarr's format in which an array is stored, once its metadata have been checked."""
    version = 2 if (folder / name / ".zarray").is_file() else 3
    path, schema = (folder / name / ".zarray", ARRAY_V2) if version == 2 else (folder / name / "zarr.json", ARRAY_V3)
    try:
        about = read_json(path, schema, "the metadata of a zarr array of numbers that runs no code of others")
    except InvalidFileError as error:
        raise DemonstrationError(
            f"{folder} is no store of the paper's layout: {error}. It must have meta/episode_ends, data/action and one array "
            "for each observation, of numbers, without filters, compressed by blosc, gzip, lz4, zlib or zstd"
        ) from error
    chunk = about["chunks"] if version == 2 else about["chunk_grid"]["configuration"]["chunk_shape"]
    shape, kind = about["shape"], about["dtype"] if version == 2 else about["data_type"]
    itemsize = int(kind[2:]) if version == 2 else int("".join(filter(str.isdigit, kind)) or 8) // 8
    if len(chunk) != len(shape):
        raise DemonstrationError(f"{path} has chunks {chunk} of an array {shape}; export the data set again")
    counts = [-(-length // part) for length, part in zip(shape, chunk, strict=True)]
    size = math.prod(count * part for count, part in zip(counts, chunk, strict=True)) * itemsize
    if size > MAX_COMPRESSION * stored or math.prod(counts) > CHUNKS_PER_FILE * num_files:
        raise DemonstrationError(
            f"{path} declares {size} bytes {shape} in {math.prod(counts)} chunks, but the store has {stored} bytes in "
            f"{num_files} files; get it again from its source"
        )
    return version
