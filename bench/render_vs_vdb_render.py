#!/usr/bin/env python3
"""Times `nuage render` against OpenVDB's `vdb_render` on one fog volume with shadow rays.

Both programs draw the same view of the same medium and are timed by the wall clock from process start to the
written PNG. See README.md beside this file for how to run it and how to read what it prints.
Needs Python 3.9 and nothing outside its standard library.
"""

import argparse
import math
import os
import re
import shutil
import statistics
import struct
import subprocess
import sys
import time
import zlib
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_INPUT = Path(os.environ.get("NUAGE_DATA", ROOT / "../shared")) / "data/static/cumulus_half_f16_blosc.vdb"

# The scene, in world units, made for the default input (voxels of 2 units, active box about 904 x 510 x 920).
CAMERA = (1250, 620, 1750)
LOOK_AT = (546, 300, 530)
UP_AXIS = "y"
FOV_HORIZONTAL_DEG = 40
TO_SUN = (0.5, 0.6, -0.2)
EXTINCTION_PER_WORLD_UNIT = 0.05  # at density 1
ALBEDO = 0.99
PRIMARY_STEP_VOXELS = 1
SHADOW_STEP_VOXELS = 3
# vdb_render has no phase function: its light of 1 is an irradiance of 4 pi under the isotropic phase 1 / (4 pi).
SUN_IRRADIANCE = 4 * math.pi


def nuage_command(run, output):
    """The command that draws the scene with nuage."""
    return [
        str(run.nuage), "render", str(run.input), "-o", str(output), "--overwrite", "--timing",
        "--grid", run.grid, "--size", f"{run.size}x{run.size}",
        "--camera", numbers(CAMERA), "--look-at", numbers(LOOK_AT), "--up", UP_AXIS,
        "--fov", str(FOV_HORIZONTAL_DEG),
        f"--sun={numbers(TO_SUN)}", "--sun-irradiance", numbers([round(SUN_IRRADIANCE, 6)] * 3),
        "--sky", "0,0,0", "--background", "0,0,0",
        "--density", str(EXTINCTION_PER_WORLD_UNIT), "--albedo", numbers([ALBEDO] * 3), "--phase", "0",
        "--step", str(PRIMARY_STEP_VOXELS), "--shadow-step", str(SHADOW_STEP_VOXELS), "--samples", "1",
        # The same share of light at which the peer ends a ray, and shadow steps that do not grow.
        "--cutoff", f"{math.sqrt(run.cutoff / 3):.6f}", "--sun-rays", str(run.sun_rays), "--shadow-growth", "0",
        "--threads", str(run.threads),
    ]  # fmt: skip


def vdb_render_command(run, output):
    """The command that draws the same scene with vdb_render.

    Its coefficients are per voxel, so the extinction is multiplied by the voxel size. `-gain 0` makes its shadow
    rays plain Beer-Lambert; `-light` points to the light and is normalised by the program.
    """
    per_voxel = EXTINCTION_PER_WORLD_UNIT * run.voxel_size
    scatter, absorb = ALBEDO * per_voxel, (1 - ALBEDO) * per_voxel
    up = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}[UP_AXIS]
    return [
        "vdb_render", str(run.input), str(output), "-v",
        "-name", run.grid, "-res", f"{run.size}x{run.size}",
        "-translate", numbers(CAMERA), "-lookat", numbers(LOOK_AT), "-up", numbers(up),
        "-fov", str(FOV_HORIZONTAL_DEG),
        "-light", numbers([*TO_SUN, 1, 1, 1]),
        "-scatter", numbers([round(scatter, 9)] * 3), "-absorb", numbers([round(absorb, 9)] * 3),
        "-gain", "0", "-cutoff", f"{run.cutoff:.9f}",
        "-step", str(PRIMARY_STEP_VOXELS), "-shadowstep", str(SHADOW_STEP_VOXELS),
        "-cpus", str(run.threads),
    ]  # fmt: skip


def nuage_render_secs(text):
    """The seconds that nuage's `--timing` names for rendering alone, or None."""
    return last_duration_secs(r"^.*\brender\w*\b\D*?([\d.]+)\s*(ms|s)\b", text)


def vdb_render_render_secs(text):
    """The seconds that vdb_render's `-v` names last, which are those of rendering, or None."""
    return last_duration_secs(r"completed in ([\d.]+)\s*(ms|milliseconds|s|sec|seconds)\b", text)


def last_duration_secs(pattern, text):
    """The last match of a pattern with groups (number, unit), in seconds."""
    found = re.findall(pattern, text, re.MULTILINE | re.IGNORECASE)
    if not found:
        return None
    value, unit = found[-1]
    return float(value) * (1e-3 if unit.startswith("m") else 1)


def numbers(values):
    """Comma-separated numbers, as both programs take them."""
    return ",".join(f"{value:g}" if isinstance(value, int) else str(value) for value in values)


# Running


def timed(command, render_secs):
    """Runs a command; returns (wall seconds, render-only seconds or None). Stops the benchmark if it fails."""
    begin = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wall = time.perf_counter() - begin
    if done.returncode != 0:
        sys.exit(f"failed with status {done.returncode}: {' '.join(command)}\n{done.stdout}")
    return wall, render_secs(done.stdout)


def require_vdb_render():
    """Installs vdb_render from Debian if it is absent and this user may; otherwise says how."""
    if shutil.which("vdb_render"):
        return
    install = ["apt-get", "install", "-y", "--no-install-recommends", "libopenvdb-tools"]
    if shutil.which("apt-get") and os.geteuid() == 0:
        print("vdb_render is absent; running:", " ".join(install), file=sys.stderr)
        subprocess.run(install, stdout=subprocess.DEVNULL)
    if not shutil.which("vdb_render"):
        sys.exit(f"vdb_render is absent; install it as root with: {' '.join(install)}")


def build_nuage():
    """Builds the release program and returns its path."""
    subprocess.run(["cargo", "build", "--release", "-p", "nuage"], cwd=ROOT, check=True)
    return (ROOT / os.environ.get("CARGO_TARGET_DIR", "target") / "release/nuage").resolve()


def machine_line(threads):
    """Date, processor, threads, load and peer version: what a record must carry."""
    cpu = "unknown processor"
    if Path("/proc/cpuinfo").exists():
        names = re.findall(r"^model name\s*:\s*(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        cpu = names[0] if names else cpu
    version = subprocess.run(["vdb_render", "-version"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    peer = " ".join(version.stdout.split())
    load = os.getloadavg()[0]
    return f"{date.today()} | {cpu} | {threads} threads of {os.cpu_count()} cores | load {load:.1f} | peer: {peer}"


# Pictures


def read_png(path):
    """(width, height, channels, rows of 8-bit samples). Non-interlaced grey or colour PNG, 8 or 16 bits."""
    data = path.read_bytes()
    chunks, at = [], 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    width, height, bits, colour, _, _, interlace = struct.unpack(">IIBBBBB", chunks[0][1])
    if bits not in (8, 16) or interlace or colour == 3:
        sys.exit(f"{path}: this kind of PNG is not read here")
    channels = {0: 1, 2: 3, 4: 2, 6: 4}[colour]
    pixel = channels * bits // 8
    raw = zlib.decompress(b"".join(body for name, body in chunks if name == b"IDAT"))
    stride = width * pixel
    rows, above = [], bytearray(stride)
    for y in range(height):
        start = y * (stride + 1)
        row = unfilter(raw[start], bytearray(raw[start + 1 : start + 1 + stride]), above, pixel)
        rows.append(row if bits == 8 else row[::2])
        above = row
    return width, height, channels, rows


def unfilter(kind, row, above, pixel):
    """Undoes one of PNG's five row filters, in place. https://www.w3.org/TR/png/#9Filters"""
    if kind == 2:
        return bytearray((a + b) & 255 for a, b in zip(row, above))
    if kind in (1, 3, 4):
        for i in range(len(row)):
            left = row[i - pixel] if i >= pixel else 0
            if kind == 1:
                guess = left
            elif kind == 3:
                guess = (left + above[i]) >> 1
            else:
                corner = above[i - pixel] if i >= pixel else 0
                to_left, to_above = abs(above[i] - corner), abs(left - corner)
                to_corner = abs(left + above[i] - 2 * corner)
                if to_left <= to_above and to_left <= to_corner:
                    guess = left
                else:
                    guess = above[i] if to_above <= to_corner else corner
            row[i] = (row[i] + guess) & 255
    return row


def srgb_to_linear(byte):
    """One 8-bit sRGB sample as linear light in 0..1 (IEC 61966-2-1)."""
    value = byte / 255
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


# vdb_render writes linear light into its PNG without any transfer curve (seen: PNG and PPM bytes are 255 x radiance).
PEER_CURVE = [byte / 255 for byte in range(256)]
NUAGE_CURVE = [srgb_to_linear(byte) for byte in range(256)]


def linear_green(path, curve):
    """The green (or grey) channel as linear light, over black."""
    width, height, channels, rows = read_png(path)
    green, alpha = (1 if channels >= 3 else 0), (channels - 1 if channels in (2, 4) else None)
    image = []
    for row in rows:
        values = [curve[byte] for byte in row[green::channels]]
        if alpha is not None:
            values = [value * byte / 255 for value, byte in zip(values, row[alpha::channels])]
        image.extend(values)
    return width, height, image


def compare_pictures(nuage_png, peer_png):
    """Lines that say how alike the two pictures are, in linear light."""
    width, height, ours = linear_green(nuage_png, NUAGE_CURVE)
    peer_width, peer_height, theirs = linear_green(peer_png, PEER_CURVE)
    if (width, height) != (peer_width, peer_height):
        return [f"pictures differ in size: {width}x{height} against {peer_width}x{peer_height}"]
    count = len(ours)
    mean, peer_mean = sum(ours) / count, sum(theirs) / count
    visible = 0.05  # Above what vdb_render's default cutoff leaves in full shadow.
    both = sum(a > visible and b > visible for a, b in zip(ours, theirs))
    either = sum(a > visible or b > visible for a, b in zip(ours, theirs))
    rms = math.sqrt(sum((a - b) ** 2 for a, b in zip(ours, theirs)) / count)
    lines = [
        f"mean linear light: nuage {mean:.4f}, vdb_render {peer_mean:.4f}",
        f"centre of light (pixels): nuage {centre_of_light(ours, width)}, vdb_render {centre_of_light(theirs, width)}",
        f"lit pixels: {either}, overlap {both / max(either, 1):.3f}; root mean square difference {rms:.4f}",
    ]
    if both < 0.9 * either or abs(mean - peer_mean) > 0.1 * peer_mean:
        lines.append("WARNING: the pictures are not of the same view or light; the times do not compare")
    return lines


def centre_of_light(image, width):
    """The light-weighted mean pixel, as text."""
    total = sum(image) or 1
    x = sum((i % width) * value for i, value in enumerate(image)) / total
    y = sum((i // width) * value for i, value in enumerate(image)) / total
    return f"({x:.1f}, {y:.1f})"


# Report


def spread(values):
    """Median and range of seconds as text; a dash where a program names none."""
    values = [value for value in values if value is not None]
    return f"{statistics.median(values):9.3f} ({min(values):.3f} .. {max(values):.3f})" if values else "        -"


def ratio(peer, ours):
    """Median over median, or a dash."""
    if None in peer or None in ours or not peer or not ours:
        return "-"
    return f"{statistics.median(peer) / max(statistics.median(ours), 1e-9):.2f}"


def report(run, times):
    """Prints the table: both clocks of both programs, and how many times faster nuage is."""
    print(f"{run.input.name}, grid {run.grid}, {run.size}x{run.size}, shadow rays, peer cutoff {run.cutoff:g}")
    print(f"{'':12}{'runs':>5}  {'start to PNG, s: median (range)':34}{'render only, s: median (range)':34}")
    for name, runs in times.items():
        wall, render = zip(*runs)
        print(f"{name:12}{len(runs):5}  {spread(wall):34}{spread(render):34}")
    (peer_wall, peer_render), (wall, render) = zip(*times["vdb_render"]), zip(*times["nuage"])
    print(f"vdb_render / nuage: start to PNG {ratio(peer_wall, wall)}, render only {ratio(peer_render, render)}")


def arguments():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--input", type=Path, default=DEFAULT_INPUT, help="the .vdb file (default: %(default)s)")
    parser.add_argument("--grid", default="density")
    parser.add_argument("--voxel-size", type=float, default=2.0, help="of that grid, in world units (default: 2)")
    parser.add_argument("--size", type=int, default=1024, help="width and height in pixels (default: 1024)")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)), help="default: all cores")
    parser.add_argument("--nuage", type=Path, help="a built program (default: build the release program)")
    parser.add_argument("--nuage-repeats", type=int, default=5)
    parser.add_argument("--peer-repeats", type=int, default=3)
    parser.add_argument(
        "--cutoff",
        type=float,
        default=0.005,
        help="vdb_render's -cutoff (default: 0.005, its own: rays end at a transmittance of 0.04)",
    )
    parser.add_argument(
        "--sun-rays",
        type=int,
        default=16,
        help="nuage's --sun-rays (default: 16, its own: steps are lit in groups; 1000000: a shadow ray per step)",
    )
    parser.add_argument("--out", type=Path, default=ROOT / "out/bench", help="folder for the pictures")
    run = parser.parse_args()
    if min(run.nuage_repeats, run.peer_repeats, run.threads, run.size) < 1:
        parser.error("repeats, threads and size must be at least 1")
    if not run.input.is_file():
        parser.error(f"no such file: {run.input} (set NUAGE_DATA to the folder that holds data/)")
    return run


def main():
    run = arguments()
    require_vdb_render()
    run.input = run.input.resolve()
    run.nuage = run.nuage.resolve() if run.nuage else build_nuage()
    run.out.mkdir(parents=True, exist_ok=True)
    pictures = {"nuage": run.out / "nuage.png", "vdb_render": run.out / "vdb_render.png"}
    for picture in pictures.values():
        picture.unlink(missing_ok=True)
    programs = {
        "nuage": (nuage_command(run, pictures["nuage"]), nuage_render_secs, run.nuage_repeats),
        "vdb_render": (vdb_render_command(run, pictures["vdb_render"]), vdb_render_render_secs, run.peer_repeats),
    }
    print(machine_line(run.threads))
    for command, _, _ in programs.values():
        print("$", " ".join(command), flush=True)

    run.input.read_bytes()  # Both find the file in the page cache.
    times = {name: [] for name in programs}
    for turn in range(max(run.nuage_repeats, run.peer_repeats)):
        for name, (command, render_secs, repeats) in programs.items():
            if turn < repeats:
                times[name].append(timed(command, render_secs))
                print(f"  run {turn + 1} {name}: {times[name][-1][0]:.3f} s", file=sys.stderr, flush=True)
    print()
    report(run, times)
    for line in compare_pictures(pictures["nuage"], pictures["vdb_render"]):
        print(line)
    print(f"pictures: {pictures['nuage']} {pictures['vdb_render']}")


if __name__ == "__main__":
    main()
