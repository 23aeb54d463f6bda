"""Assignment of contiguous ranges of states to the devices of a mesh axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxltl.core import validation
from jaxltl.core.models.mesh.lanes import automatic, axes_of


class StateLayout(NamedTuple):
    """The assignment of states to devices."""

    mesh: Mesh
    axis: str
    num_given: int
    order: np.ndarray | None = None

    @property
    def starts(self) -> np.ndarray:
        """The first state of each range, and S."""
        return np.arange(self.parts + 1) * self.num_given // self.parts

    @property
    def size(self) -> int:
        return -(-self.num_given // self.parts)

    def place(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The range of each state, and its place there."""
        range_ = np.searchsorted(self.starts, state, "right") - 1
        return range_, state - self.starts[range_]

    @property
    def parts(self) -> int:
        return int(self.mesh.shape[self.axis])

    @property
    def sharding(self) -> NamedSharding:
        return NamedSharding(self.mesh, PartitionSpec(self.axis))

    def devices(self, d: int) -> list[jax.Device]:
        """The devices with the d-th range, more than one where the mesh has other axes."""
        along = self.mesh.axis_names.index(self.axis)
        return list(np.moveaxis(self.mesh.devices, along, 0)[d : d + 1].ravel())

    def owner(self, d: int) -> int:
        """The process that sends a range's data."""
        return int(min(device.process_index for device in self.devices(d)))

    @property
    def mine(self) -> list[int]:
        """The ranges of which this process holds a copy."""
        here, each = jax.process_index(), range(self.parts)
        return [d for d in each if any(x.process_index == here for x in self.devices(d))]

    def span(self, d: int) -> tuple[int, int]:
        return int(self.starts[d]), int(self.starts[d + 1])

    def array(self, pieces: Mapping[int, np.ndarray]) -> jax.Array:
        arrays = [
            jax.device_put(piece, device)
            for d, piece in pieces.items()
            for device in self.devices(d)
            if device.process_index == jax.process_index()
        ]
        some = next(iter(pieces.values()))
        shape = (some.shape[0] * self.parts, *some.shape[1:])
        return jax.make_array_from_single_device_arrays(shape, self.sharding, arrays)

    def replicated(self, x: np.ndarray) -> jax.Array:
        return jax.make_array_from_callback(
            x.shape, NamedSharding(self.mesh, PartitionSpec()), lambda index: x[index]
        )

    def exchanged(self, pieces: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """The pieces of all ranges, in every process; only their first axes differ."""
        if jax.process_count() == 1:
            return [pieces[d] for d in range(self.parts)]
        from jax.experimental import multihost_utils

        length = np.zeros(self.parts, np.int64)
        for d, piece in pieces.items():
            length[d] = len(piece)
        length = np.asarray(multihost_utils.process_allgather(length)).max(0)
        some = next(iter(pieces.values()))
        padded = np.zeros((self.parts, int(length.max()), *some.shape[1:]), some.dtype)
        for d, piece in pieces.items():
            padded[d, : len(piece)] = piece
        # As bytes, since JAX may be restricted to single precision.
        every = np.asarray(multihost_utils.process_allgather(padded.view(np.uint8)))
        return [
            np.ascontiguousarray(every[self.owner(d), d]).view(some.dtype)[: length[d]]
            for d in range(self.parts)
        ]


def state_layout(num_states: int, mesh: Mesh, axis: str | None) -> StateLayout:
    """Layout of states on the devices of a mesh axis."""
    validation.instance("mesh", mesh, Mesh, "a jax.sharding.Mesh, such as jax.make_mesh makes")
    names = axes_of(mesh, axis)
    if len(names) != 1:
        raise ValueError(f"the mesh has axes {mesh.axis_names}; name one of them as axis.")
    axis = names[0]
    if num_states < mesh.shape[axis]:
        raise ValueError(
            f"{num_states} states cannot lie on {mesh.shape[axis]} devices; give a mesh of fewer."
        )
    return StateLayout(automatic(mesh), axis, num_states)
