"""Writes the weights of ST-LPIPS (AlexNet) and I3D (Kinetics-400) as one safetensors file.

Both come as pickles, which may run anything: only the handful of names that weights need is understood, so neither
torch nor numpy is needed. Layouts stay as they are in the packages (I3D's kernels are depth, height, width, in, out).

    python3 convert.py alex_shift_tolerant.pth i3d-kinetics-400.ckpt perceptual.safetensors
"""

import collections
import json
import math
import os
import pickle
import struct
import sys

FLOAT_BYTES = 4


class Storage:
    """Numbers of a PyTorch file, which follow behind its pickles."""

    data = b""


class Weights:
    """A tensor of single precision in row-major order."""

    def __init__(self, shape, storage, offset):
        self.shape, self.storage, self.offset = tuple(shape), storage, offset

    def bytes(self):
        start = self.offset * FLOAT_BYTES
        return self.storage.data[start : start + math.prod(self.shape) * FLOAT_BYTES]


def rebuild_tensor(storage, offset, shape, strides, *_):
    expected = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    if any(size > 1 and have != want for size, have, want in zip(shape, strides, expected)):
        raise ValueError(f"a tensor of shape {shape} has strides {strides}, expected {expected}")
    return Weights(shape, storage, offset)


class TorchUnpickler(pickle.Unpickler):
    """Reads a pickle of PyTorch's format from before version 1.6; the file is several, and `storages` belongs to all."""

    def __init__(self, file, storages):
        super().__init__(file)
        self.storages = storages

    def find_class(self, module, name):
        known = {
            "_rebuild_tensor_v2": rebuild_tensor,
            "OrderedDict": collections.OrderedDict,
            "FloatStorage": "f32",
            "LongStorage": "i64",
        }
        if name not in known:
            raise ValueError(f"{module}.{name} is not known in a file of weights")
        return known[name]

    def persistent_load(self, saved):
        _, kind, key, *_ = saved
        storage = self.storages.setdefault(key, Storage())
        storage.item_bytes = {"f32": 4, "i64": 8}[kind]
        return storage


def read_torch(path):
    storages = {}
    with open(path, "rb") as file:
        _magic, _protocol, _system, tensors, keys = (
            TorchUnpickler(file, storages).load() for _ in range(5)
        )
        for key in keys:
            storage = storages[key]
            (count,) = struct.unpack("<Q", file.read(8))
            storage.data = file.read(count * storage.item_bytes)
    return {
        name: tensor for name, tensor in tensors.items() if tensor.storage.item_bytes == FLOAT_BYTES
    }


class Dtype:
    """numpy's, as far as single precision needs it."""

    def __init__(self, name, *_):
        if name != "f4":
            raise ValueError(f"the numbers are {name}, expected f4")

    def __setstate__(self, state):
        if state[1] != "<":
            raise ValueError("the numbers are not little-endian")


class Array(Weights):
    """numpy's, as far as single precision needs it."""

    def __init__(self, *_):
        super().__init__((), Storage(), 0)

    def __setstate__(self, state):
        _, shape, _, column_major, data = state
        if column_major:
            raise ValueError("an array is column-major")
        self.shape = tuple(shape)
        self.storage.data = data


class NumpyUnpickler(pickle.Unpickler):
    def find_class(self, module, name):
        known = {"_reconstruct": Array, "ndarray": Array, "dtype": Dtype}
        if not module.startswith("numpy") or name not in known:
            raise ValueError(f"{module}.{name} is not known in a file of weights")
        return known[name]


def flatten(tree, prefix):
    for name, value in tree.items():
        path = f"{prefix}.{name.replace('/', '.')}"
        if isinstance(value, Weights):
            yield path, value
        else:
            yield from flatten(value, path)


def main(alex, i3d, target):
    weights = dict(flatten(read_torch(alex), "st_lpips"))
    with open(i3d, "rb") as file:
        weights.update(flatten(NumpyUnpickler(file).load(), "i3d"))
    header, data = {}, bytearray()
    for name, tensor in sorted(weights.items()):
        start = len(data)
        data += tensor.bytes()
        header[name] = {"dtype": "F32", "shape": tensor.shape, "data_offsets": [start, len(data)]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(target + ".part", "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + data)
    os.replace(target + ".part", target)


if __name__ == "__main__":
    main(*sys.argv[1:])
