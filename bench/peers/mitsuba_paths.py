"""One picture by Mitsuba 3: mitsuba_paths.py SCENE.json VARIANT SAMPLES SEED THREADS OUT.npy. See paths.py."""

import json
import sys

import mitsuba as mi
import numpy as np

scene_path, variant, samples, seed, threads, out = sys.argv[1:]
with open(scene_path) as file:
    scene = json.load(file)
mi.set_variant(variant)
if variant.startswith("scalar"):
    mi.Thread.thread().set_thread_count(int(threads)) if hasattr(mi.Thread.thread(), "set_thread_count") else None
else:
    import drjit

    drjit.set_thread_count(int(threads))
transform = mi.ScalarTransform4f()
grid = np.load(scene["dense"])
# Its samples lie in the middle of cells: half a voxel beyond the first and the last.
low = (grid["first"] - 0.5) * float(grid["voxel"])
size = np.array(grid["density"].shape) * float(grid["voxel"])
world_from_unit = transform.translate(low.tolist()).scale(size.tolist())
density = np.ascontiguousarray(grid["density"].transpose(2, 1, 0))[..., None]


def raw(colour):
    return {"type": "rgb", "value": colour}


medium = {
    "type": "heterogeneous",
    "albedo": {"type": "constvolume", "value": scene["albedo"]},
    "scale": scene["extinction"],
    "phase": {"type": "hg", "g": scene["g"]} if scene["g"] else {"type": "isotropic"},
    "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(density), "raw": True, "to_world": world_from_unit},
}
film = {"type": "hdrfilm", "width": scene["size"], "height": scene["size"], "component_format": "float32"}
film["rfilter"] = {"type": "box"}
camera = transform.look_at(origin=scene["camera"], target=scene["look_at"], up=[0, 0, 1])
picture = mi.render(
    mi.load_dict(
        {
            "type": "scene",
            # The first of its depths is what is seen without scattering.
            "integrator": {"type": "volpath", "max_depth": scene["scatterings"] + 1, "rr_depth": 1000},
            "sensor": {
                "type": "perspective",
                "fov": scene["fov"],
                "fov_axis": "x",
                "to_world": camera,
                "film": film,
                "sampler": {"type": "independent"},
            },
            "medium": {
                "type": "cube",
                "to_world": world_from_unit @ transform.translate([0.5] * 3).scale(0.5),
                "bsdf": {"type": "null"},
                "interior": medium,
            },
            "sky": {"type": "constant", "radiance": raw(scene["sky"])},
            "sun": {
                "type": "directional",
                "direction": [-x for x in scene["to_sun"]],
                "irradiance": raw([scene["irradiance"]] * 3),
            },
        }
    ),
    spp=int(samples),
    seed=int(seed),
)
np.save(out, np.array(picture)[..., :3])
