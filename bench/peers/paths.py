"""Times path tracers to equal noise: `nuage render` against Mitsuba 3 and Blender's Cycles. Run by paths_vs_peers.sh.

paths.py NUAGE PYTHON3 OUT FOG.vdb CHIMNEY.vdb, with ROUNDS, SIZE, THREADS and SCENES from the environment. PYTHON3 is one with
OpenVDB's module, this one needs those of Mitsuba and Blender. See ../README.md for how to read the table.
"""

import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import mitsuba
import numpy as np

HERE = Path(__file__).resolve().parent
THREADS = int(os.environ.get("THREADS", len(os.sched_getaffinity(0))))
ROUNDS = int(os.environ.get("ROUNDS", 3))
SIZE = int(os.environ.get("SIZE", 256))

# Light may scatter so often in every program.
SCATTERINGS = 64
# Paths per pixel of a short run, whose time is mostly set-up, and of a long one.
SAMPLES = {"nuage": (4, 64), "Cycles": (4, 32), "Mitsuba llvm": (4, 32), "Mitsuba scalar": (4, 32)}
# A converged picture has so many times the paths of a long run.
CONVERGED = 4
# Programs with the same estimator share a converged picture.
SHARED = {"Mitsuba scalar": "Mitsuba llvm"}
LIGHT = {"to_sun": [0.557, -0.321, 0.766], "irradiance": 6.0, "sky": [0.3, 0.4, 0.6], "albedo": 0.99}


def scenes(fog, chimney):
    """The scenes by name."""
    views = {
        "fog": {"file": fog, "camera": [0, -67.2, 8.96], "look_at": [0, 0, 0], "extinction": 1.0},
        "chimney": {"file": chimney, "camera": [4.16, -6, 3.5], "look_at": [4.16, 1.97, 2.31], "extinction": 15.0},
    }
    chosen = os.environ.get("SCENES", "").split(",")
    return {
        name: {**LIGHT, **view, "fov": 45.0, "g": g, "size": SIZE, "scatterings": SCATTERINGS}
        for view_name, view in views.items()
        for g in (0.0, 0.8)
        if (name := f"{view_name} g {g:g}") and (chosen == [""] or name in chosen)
    }


def scene_file(scene):
    """The scene for nuage."""
    return f"""
camera = {{ position = {scene["camera"]}, look_at = {scene["look_at"]}, up = "z", fov = {scene["fov"]} }}
film = {{ size = {scene["size"]} }}
integrator = {{ kind = "path", scatterings = {scene["scatterings"]} }}
sky = {{ radiance = {scene["sky"]} }}
[[lights]]
kind = "sun"
position = {scene["to_sun"]}
irradiance = {scene["irradiance"]}
[[volumes]]
file = "{scene["file"]}"
extinction = {scene["extinction"]}
albedo = {scene["albedo"]}
phase = {scene["g"]}
"""


def command(program, stem, samples, seed, out):
    """The command that draws a scene, whose files are called `stem` and something."""
    match program:
        case "nuage":
            options = ["--samples", samples, "--seed", seed, "--threads", THREADS, "--exr-float", "--overwrite"]
            return [sys.argv[1], "render", "--scene", f"{stem}.toml", "-o", out, *options]
        case "Cycles":
            return [sys.executable, HERE / "cycles_paths.py", f"{stem}.json", samples, seed, THREADS, out]
        case _:
            variant = program.removeprefix("Mitsuba ") + ("_rgb" if program.endswith("scalar") else "_ad_rgb")
            return [sys.executable, HERE / "mitsuba_paths.py", f"{stem}.json", variant, samples, seed, THREADS, out]


def draw(program, stem, samples, seed):
    """The picture, and the wall and processor seconds of the whole process."""
    out = stem.with_name(f"{stem.name} {program}.{'npy' if program.startswith('Mitsuba') else 'exr'}")
    out.unlink(missing_ok=True)
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    line = [str(word) for word in command(program, stem, samples, seed, out)]
    done = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0 or not out.is_file():
        sys.exit(f"{program} failed with status {done.returncode}: {' '.join(line)}\n{done.stdout}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"  {stem.name} {program} {samples}: {wall:.2f} s, {cpu:.2f} s of processors", file=sys.stderr, flush=True)
    return read(out), wall, cpu


def read(path):
    """Red, green and blue of a picture."""
    if path.suffix == ".npy":
        return np.load(path).astype(np.float64)
    bitmap = mitsuba.Bitmap(str(path))
    rgb = bitmap.convert(mitsuba.Bitmap.PixelFormat.RGB, mitsuba.Struct.Type.Float32, False)
    return np.array(rgb, np.float64)


def converged(program, stem):
    """The program's converged picture, which is kept for the next time."""
    kept = stem.with_name(f"{stem.name} {program} converged.npy")
    if not kept.is_file():
        np.save(kept, draw(program, stem, SAMPLES[program][1] * CONVERGED, 1000)[0])
    return np.load(kept)


def compare(name, scene, out):
    """Runs the programs on a scene and prints its rows."""
    stem = out / f"{name} {SIZE}"
    scene["dense"] = str(out / f"{Path(scene['file']).stem}.npz")
    if not Path(scene["dense"]).is_file():
        subprocess.run([sys.argv[2], HERE / "dense.py", scene["file"], "density", scene["dense"]], check=True)
    stem.with_name(f"{stem.name}.json").write_text(json.dumps(scene))
    stem.with_name(f"{stem.name}.toml").write_text(scene_file(scene))
    references = {p: converged(SHARED.get(p, p), stem) for p in SAMPLES}
    means = {p: picture.mean((0, 1)) for p, picture in references.items()}
    for program, mean in means.items():
        off = np.abs(mean / means["nuage"] - 1).max()
        print(f"{name}: mean of {program} {np.round(mean, 5)}, off by {100 * off:.2f} %", flush=True)
        if off > 0.005:
            sys.exit(f"{name}: the pictures differ: the mean of {program} is {mean}, of nuage {means['nuage']}")
    times = {p: ([], []) for p in SAMPLES}
    errors = {p: [] for p in SAMPLES}
    for round_ in range(ROUNDS):
        for program, counts in SAMPLES.items():
            for samples, found in zip(counts, times[program], strict=True):
                picture, *secs = draw(program, stem, samples, round_)
                found.append(secs)
            reference = SAMPLES[SHARED.get(program, program)][1] * CONVERGED
            # What the converged picture lacks itself is part of the difference.
            squared = np.mean((picture - references[program]) ** 2) / (1 + counts[1] / reference)
            errors[program].append(squared)
    mean = {p: statistics.mean(errors[p]) for p in SAMPLES}
    # All come to the noise that Cycles has.
    target = mean["Cycles"]
    rows = {}
    for program, (few, many) in SAMPLES.items():
        [[wall_few, cpu_few], [wall_many, cpu_many]] = np.median(np.array(times[program]), axis=1)
        per_sample = np.array([wall_many - wall_few, cpu_many - cpu_few]) / (many - few)
        samples = many * mean[program] / target
        after = samples * per_sample
        rows[program] = (samples, np.array([wall_few, cpu_few]) - few * per_sample + after, after)
    print(f"{'scene':<14} {'program':<15} {'RMSE':>8} {'paths':>8} {'wall':>9} {'CPU':>8} {'w/o set-up':>10} {'CPU':>7}")
    for program, (samples, whole, after) in rows.items():
        print(
            f"{name:<14} {program:<15} {mean[program] ** 0.5:8.4f} {samples:8.1f}"
            f" {whole[0]:9.2f} {whole[1]:8.2f} {after[0]:9.2f} {after[1]:8.2f}"
        )
    best = [np.min([row[i] for p, row in rows.items() if p != "nuage"], axis=0) / rows["nuage"][i] for i in (1, 2)]
    print(
        f"{name:<14} best peer over nuage {'':12} {best[0][0]:9.2f} {best[0][1]:8.2f} {best[1][0]:9.2f} {best[1][1]:8.2f}",
        flush=True,
    )
    return best


def main():
    out = Path(sys.argv[3])
    mitsuba.set_variant("scalar_rgb")
    blender = subprocess.run(
        [sys.executable, "-c", "import bpy, os; print(bpy.app.version_string, flush=True); os._exit(0)"],
        capture_output=True, text=True, check=True,
    ).stdout.split()[-1]  # fmt: skip
    with open("/proc/cpuinfo") as file:
        cpu = next((line.split(":")[1].strip() for line in file if line.startswith("model name")), platform.machine())
    print(
        f"{date.today()} | {cpu} | {os.cpu_count()} cores | load {os.getloadavg()[0]:.2f} | Mitsuba {mitsuba.__version__},"
        f" Blender {blender} | {SIZE}², {THREADS} threads, {ROUNDS} rounds, medians; seconds of the wall and of processors"
    )
    results = [compare(name, scene, out) for name, scene in scenes(*sys.argv[4:]).items()]
    if min(np.min(result) for result in results) < 2:
        print("the floor of 2 is missed")


if __name__ == "__main__":
    main()
