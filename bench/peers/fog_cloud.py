#!/usr/bin/python3
"""Makes a cloud of 448 x 339 x 439 voxels by OpenVDB's Python module, the same each time: fog_cloud.py OUT.vdb.

An ellipsoid with soft edges, frayed by six octaves of noise on lattices of 4 to 128 cells.
"""

import sys

import numpy as np
import pyopenvdb

SIDE = 448
VOXEL = 0.1


def spread(values, axis):
    """A lattice of numbers made SIDE long along an axis, smoothly."""
    cells = values.shape[axis] - 1
    place = (np.arange(SIDE) + 0.5) / SIDE * cells
    cell = np.minimum(place.astype(int), cells - 1)
    part = (place - cell).astype(np.float32)
    part = (part * part * (3 - 2 * part)).reshape([-1 if i == axis else 1 for i in range(3)])
    return np.take(values, cell, axis) * (1 - part) + np.take(values, cell + 1, axis) * part


random = np.random.default_rng(7)
noise, amplitude = np.zeros([SIDE] * 3, np.float32), 1.0
for cells in (4, 8, 16, 32, 64, 128):
    octave = random.random((cells + 1,) * 3, dtype=np.float32) * 2 - 1
    for axis in range(3):
        octave = spread(octave, axis)
    noise += amplitude * octave
    amplitude *= 0.55
line = ((np.arange(SIDE) + 0.5) / SIDE * 2 - 1).astype(np.float32)
x, y, z = np.ix_(line / 0.95, line / 0.7, line / 0.85)
density = np.clip((0.8 - np.sqrt(x * x + y * y + z * z)) * 1.6 + noise * 0.62, 0, 1)
density = density * density * (3 - 2 * density)
density[density < 0.01] = 0

grid = pyopenvdb.FloatGrid()
grid.copyFromArray(density, ijk=(-SIDE // 2,) * 3, tolerance=0.0)
grid.prune()
grid.name, grid.gridClass = "density", pyopenvdb.GridClass.FOG_VOLUME
grid.transform = pyopenvdb.createLinearTransform(voxelSize=VOXEL)
pyopenvdb.write(sys.argv[1], grids=[grid])
