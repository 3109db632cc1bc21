"""Reads a file with OpenVDB and tells what it finds.

    read_grids.py FILE PROBES TRUTH

PROBES is a JSON list of index coordinates. TRUTH becomes a JSON list with an entry per grid, whose probes are values,
active states and depths at those coordinates.
"""

import json
import sys

try:
    import pyopenvdb as vdb
except ImportError:
    import openvdb as vdb


def numbers(value):
    return [float(x) for x in value] if isinstance(value, tuple) else [float(value)]


def describe(grid, coords):
    accessor = grid.getConstAccessor()
    probes = []
    for ijk in coords:
        value, active = accessor.probeValue(tuple(ijk))
        probes.append([numbers(value), active, accessor.getValueDepth(tuple(ijk))])
    return {
        "name": grid.name,
        "half": grid.saveFloatAsHalf,
        "class": grid.gridClass,
        "metadata": {key: str(value) for key, value in grid.metadata.items()},
        "background": numbers(grid.background),
        "active_voxels": grid.activeVoxelCount(),
        "leaves": grid.leafCount(),
        "memory_bytes": grid.memUsage(),
        "corner": grid.transform.indexToWorld((10, -20, 30)),
        "probes": probes,
    }


def main(file, probes, truth):
    with open(probes, encoding="utf-8") as text:
        coords = json.load(text)
    grids, _ = vdb.readAll(file)
    with open(truth, "w", encoding="utf-8") as out:
        json.dump([describe(grid, coords) for grid in grids], out)


if __name__ == "__main__":
    main(*sys.argv[1:])
