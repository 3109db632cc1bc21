#!/usr/bin/python3
"""A grid of a .vdb file as a dense array, for a renderer that reads none.

dense.py FILE.vdb GRID OUT.npz, by OpenVDB's Python module. The array has a layer of zeros around the active box, so that
interpolation fades out as it does in the tree; `first` is the index of its first voxel, `voxel` the size of one.
"""

import sys

import numpy as np
import pyopenvdb

path, name, out = sys.argv[1:]
grid = pyopenvdb.read(path, name)
low, high = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
first = low - 1
dense = np.zeros(high - low + 3, np.float32)
grid.copyToArray(dense, ijk=tuple(int(i) for i in first))
np.savez(out, density=dense, first=first, voxel=grid.transform.voxelSize()[0])
