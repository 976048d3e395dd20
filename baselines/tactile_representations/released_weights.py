"""Reads the tensors of a `.ckpt` or `.pth` file that others have released, and runs nothing of it.

Such a file is a zip with a pickle, and a pickle is a program that can call any function by its name. The reader here knows
only the names that torch writes for tensors. Every other name, such as that of the authors' scheduler or `os.system`, gives an
object that holds nothing and does nothing. Tensors are read after the pickle has ended, and only those that are asked for.
"""

import io
import math
import pickle
import pickletools
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

STORAGES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
"""torch's names of the types of numbers."""
PROTOCOL = 2
"""Version of pickle's language that torch writes; later ones have commands that reserve memory."""
NESTING = ("model", "state_dict")
"""Names under which checkpoints of training programs keep the weights."""


def read_released(path: Path, wanted: str = "the file that the authors released") -> dict[str, torch.Tensor]:
    """The weights of a file that torch has written, bare or in a training program's checkpoint.

    Args:
        path: Path of the file.
        wanted: The file that should be given, for the error's message.

    Raises:
        CheckpointError: The file is missing, broken, of another kind, or holds no weights.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(archive, Path(path).stat().st_size)
    except Exception as error:  # zip and pickle raise many kinds over foreign data
        raise CheckpointError(
            f"{path} cannot be read as weights ({type(error).__name__}: {error}); give {wanted}, as torch 1.6 or later "
            "writes it"
        ) from error


def _read(archive: zipfile.ZipFile, file_size: int) -> dict[str, torch.Tensor]:
    parts = {info.filename.partition("/")[2]: info for info in archive.infolist()}
    if any(info.compress_type != zipfile.ZIP_STORED for info in parts.values()):
        raise ValueError("its parts are compressed, which torch does not do")
    if "byteorder" in parts and archive.read(parts["byteorder"]) != b"little":
        raise ValueError("its numbers are big-endian")
    content = _unpickle(archive.read(parts["data.pkl"]))
    for key in NESTING:
        content = dict.get(content, key, content)
    found = {name: tensor for name, tensor in dict.items(content) if isinstance(tensor, _Tensor)}
    if not found:
        raise ValueError(f"it holds no tensors by name, but {[str(name) for name in dict(content)][:10]}")
    if sum(tensor.size for tensor in found.values()) > file_size:
        raise ValueError("its tensors are larger than the file")
    return {str(name): tensor.read(archive, parts) for name, tensor in found.items()}


@dataclass(frozen=True)
class _Tensor:
    """The place of a tensor in the file, as the pickle describes it."""

    storage: Any
    offset: Any
    shape: Any
    stride: Any

    @property
    def size(self) -> int:
        """Number of bytes."""
        whole = (self.offset, *self.shape, *self.stride)
        if not isinstance(self.storage, _Storage) or not all(type(number) is int and number >= 0 for number in whole):
            raise ValueError("a tensor is not described as torch describes one")
        return math.prod(self.shape) * self.storage.dtype.itemsize

    def read(self, archive: zipfile.ZipFile, parts: dict[str, zipfile.ZipInfo]) -> torch.Tensor:
        """The tensor, a copy of its own."""
        stored = bytearray(archive.read(parts[f"data/{self.storage.key}"]))
        if self.size == 0:
            return torch.zeros(self.shape, dtype=self.storage.dtype)
        numbers = torch.frombuffer(stored, dtype=self.storage.dtype)
        return numbers.as_strided(self.shape, self.stride, self.offset).clone()  # torch refuses what is out of bounds


@dataclass(frozen=True)
class _Storage:
    """A part of the file that holds the numbers of one or more tensors."""

    dtype: torch.dtype
    key: str


class _RebuildTensor:
    """Stands for `torch._utils._rebuild_tensor_v2`."""

    __slots__ = ()

    def __call__(self, storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> _Tensor:
        return _Tensor(storage, offset, shape, stride)


class _RebuildParameter:
    """Stands for `torch._utils._rebuild_parameter`."""

    __slots__ = ()

    def __call__(self, tensor: Any, *_: Any) -> Any:
        return tensor


class _Inert:
    """An object of any other class or the result of any other function; it holds nothing and does nothing."""

    def __new__(cls, *_: Any, **__: Any) -> "_Inert":
        return object.__new__(cls)

    def __init__(self, *_: Any, **__: Any):
        pass

    def _ignore(self, *_: Any) -> None:
        pass

    __setstate__ = __setitem__ = append = extend = add = _ignore


KNOWN = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _RebuildTensor(),
    ("torch._utils", "_rebuild_parameter"): _RebuildParameter(),
    **{("torch", name): dtype for name, dtype in STORAGES.items()},
}
"""All that a name in the pickle can stand for."""


class _TensorUnpickler(pickle._Unpickler):  # pyright: ignore[reportAttributeAccessIssue]
    """Python's unpickler that is written in Python: the one in C reserves as much memory as a pickle asks for."""

    def find_class(self, module: str, name: str) -> Any:
        return KNOWN.get((module, name)) or type(name, (_Inert,), {})

    def persistent_load(self, pid: Any) -> _Storage:
        kind, dtype, key, *_ = pid
        if kind != "storage" or not isinstance(dtype, torch.dtype) or not isinstance(key, str):
            raise ValueError(f"its storage {pid} is not one that torch writes")
        return _Storage(dtype, key)


def _unpickle(program: bytes) -> Any:
    """The content of a pickle, with stand-ins for tensors and for all other objects."""
    later = {opcode.name for opcode, _, _ in pickletools.genops(program) if opcode.proto > PROTOCOL}
    if later:
        raise ValueError(f"its pickle has the commands {sorted(later)}, which torch does not write")
    content = _TensorUnpickler(io.BytesIO(program)).load()
    if not isinstance(content, dict):
        raise ValueError(f"it holds a {type(content).__name__} instead of weights by name")
    return content
