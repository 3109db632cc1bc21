"""Writes random float grids with OpenVDB, and what OpenVDB reads back from them.

    write_grids.py FOLDER     writes *.vdb and truth.json
    write_grids.py --check    succeeds if OpenVDB's Python module is there

truth.json holds a list of grids per file. All values are those of the grid as read back from the file, so that
the rounding of half floats is OpenVDB's own.
"""

import json
import os
import random
import sys

try:
    import pyopenvdb as vdb
except ImportError:
    import openvdb as vdb

SEEDS_PER_FILE = {"plain.vdb": range(0, 6), "half.vdb": range(6, 12), "level.vdb": range(12, 15), "one.vdb": [15]}
METADATA = {
    "text": ("smoke, \u00fcber", "smoke, \u00fcber"),
    "yes": (True, "true"),
    "count": (-7, "-7"),
    "ratio": (0.375, "0.375"),
    "corner": ((1, -2, 3), "[1, -2, 3]"),
}
MATRICES = [
    [[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1]],
    [[0.1, 0, 0, 0], [0, 0.2, 0, 0], [0, 0, 0.3, 0], [-5, 7, 0.25, 1]],
    [[0.8, 0.6, 0, 0], [-0.6, 0.8, 0, 0], [0, 0, 1.5, 0], [1, 2, 3, 1]],
    [[1, 0.2, 0, 0], [0, 1, 0.3, 0], [0.1, 0, -1, 0], [0, 0, 100, 1]],
]


def make_grid(name, rng, half, level_set):
    background = rng.choice([0.0, 0.0, 1.5, -3.25])
    if level_set:
        background = 3.0
    grid = vdb.FloatGrid(background=background)
    grid.name = name
    grid.saveFloatAsHalf = half
    if level_set:
        grid.gridClass = vdb.GridClass.LEVEL_SET
    elif rng.random() < 0.5:
        grid.gridClass = vdb.GridClass.FOG_VOLUME
    grid.transform = vdb.createLinearTransform(rng.choice(MATRICES))
    for key, (value, _) in METADATA.items():
        grid[key] = value
    touched = []
    # Tiles of all levels: a box of this size swallows whole nodes.
    for _ in range(rng.randrange(3)):
        size = rng.choice([5, 40, 300, 5000])
        low = tuple(rng.randrange(-6000, 2000) for _ in range(3))
        high = tuple(c + rng.randrange(size // 2, size) for c in low)
        # Thin in one axis, so that few leaves are made at the faces.
        axis = rng.randrange(3)
        if size > 40:
            high = tuple(low[i] + 9 if i == axis else high[i] for i in range(3))
        if size < 5000:
            grid.fill(low, high, rng.uniform(-2, 2), rng.random() < 0.8)
            touched += [low, high, tuple((a + b) // 2 for a, b in zip(low, high))]
    if rng.random() < 0.6:
        # Aligned boxes become tiles of 8, 128 and 4096 voxels.
        for size in (8, 128, 4096):
            low = tuple(size * rng.randrange(-4, 4) for _ in range(3))
            grid.fill(low, tuple(c + size - 1 for c in low), rng.uniform(-2, 2), rng.random() < 0.8)
            touched += [low, tuple(c + size // 2 for c in low)]
    accessor = grid.getAccessor()
    for _ in range(rng.randrange(2, 8)):
        centre = [rng.randrange(-3000, 3000) for _ in range(3)]
        for _ in range(rng.choice([1, 30, 600])):
            ijk = tuple(c + int(rng.gauss(0, 6)) for c in centre)
            value = rng.choice([rng.uniform(-1, 1), 0.0, background, -background, 0.25])
            # Inactive voxels of none, one, two and more values beside the background.
            if rng.random() < 0.7:
                accessor.setValueOn(ijk, value)
            else:
                accessor.setValueOff(ijk, value if rng.random() < 0.3 else rng.choice([background, -background]))
            touched.append(ijk)
    return grid, touched


def truth_of(grid, touched, rng):
    accessor = grid.getConstAccessor()
    around = [tuple(c + rng.randrange(-9, 10) for c in ijk) for ijk in touched]
    anywhere = [tuple(rng.randrange(-9000, 9000) for _ in range(3)) for _ in range(100)]
    probes = []
    for ijk in touched[-400:] + touched[:100] + around[-300:] + anywhere:
        value, active = accessor.probeValue(ijk)
        probes.append([ijk, value, active, accessor.getValueDepth(ijk)])
    indices = [(0, 0, 0), (1, 0, 0), (0, 10, 0), (-7, 5, 300)]
    return {
        "name": grid.name,
        "half": grid.saveFloatAsHalf,
        "class": {"unknown": "unknown", "level set": "level set", "fog volume": "fog volume"}[grid.gridClass],
        "metadata": {key: text for key, (_, text) in METADATA.items()},
        "background": grid.background,
        "active_voxels": grid.activeVoxelCount(),
        "leaves": grid.leafCount(),
        "bbox": grid.evalActiveVoxelBoundingBox(),
        "min_max": grid.evalMinMax(),
        "index_to_world": [[ijk, grid.transform.indexToWorld(ijk)] for ijk in indices],
        "probes": probes,
    }


def main(folder):
    truth = {}
    for file, seeds in SEEDS_PER_FILE.items():
        path = os.path.join(folder, file)
        made = []
        for seed in seeds:
            rng = random.Random(seed)
            made.append((*make_grid(f"grid{seed}", rng, file == "half.vdb", file == "level.vdb"), rng))
        vdb.write(path, grids=[grid for grid, _, _ in made])
        truth[file] = [truth_of(vdb.read(path, grid.name), touched, rng) for grid, touched, rng in made]
    with open(os.path.join(folder, "truth.json"), "w", encoding="utf-8") as out:
        json.dump(truth, out)


if __name__ == "__main__":
    if sys.argv[1:] != ["--check"]:
        main(sys.argv[1])
