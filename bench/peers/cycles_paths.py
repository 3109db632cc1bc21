"""One picture by Blender's Cycles: cycles_paths.py SCENE.json SAMPLES SEED THREADS OUT.exr. See paths.py."""

import json
import math
import os
import sys

import bpy
from mathutils import Vector

scene_path, samples, seed, threads, out = sys.argv[1:]
with open(scene_path) as file:
    scene = json.load(file)
bpy.ops.wm.read_factory_settings(use_empty=True)
stage = bpy.context.scene
render, cycles = stage.render, stage.cycles
render.engine = "CYCLES"
cycles.device = "CPU"
cycles.samples, cycles.seed = int(samples), int(seed)
cycles.use_adaptive_sampling = cycles.use_denoising = cycles.volume_biased = False
# What it calls bounces of a volume are the scatterings behind the first.
cycles.max_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = scene["scatterings"] - 1
cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
cycles.pixel_filter_type = "BOX"
cycles.filter_width = 1
render.threads_mode, render.threads = "FIXED", int(threads)
render.resolution_x = render.resolution_y = scene["size"]
render.resolution_percentage = 100
render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
render.filepath = out


def add(name, data):
    thing = bpy.data.objects.new(name, data)
    stage.collection.objects.link(thing)
    return thing


volume = bpy.data.volumes.new("volume")
volume.filepath = scene["file"]
volume.render.precision = "FULL"
add("volume", volume)
volume.grids.load()
material = bpy.data.materials.new("medium")
material.use_nodes = True
nodes = material.node_tree.nodes
nodes.clear()
medium = nodes.new("ShaderNodeVolumePrincipled")
medium.inputs["Density"].default_value = scene["extinction"]
medium.inputs["Color"].default_value = [scene["albedo"]] * 3 + [1]
medium.inputs["Anisotropy"].default_value = scene["g"]
material.node_tree.links.new(medium.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Volume"])
volume.materials.append(material)

sun = bpy.data.lights.new("sun", "SUN")
sun.energy, sun.angle = scene["irradiance"], 0
add("sun", sun).rotation_euler = Vector(scene["to_sun"]).to_track_quat("Z", "Y").to_euler()
world = bpy.data.worlds.new("sky")
world.use_nodes = True
world.node_tree.nodes["Background"].inputs[0].default_value = (*scene["sky"], 1)
stage.world = world

lens = bpy.data.cameras.new("camera")
lens.angle = math.radians(scene["fov"])
camera = add("camera", lens)
camera.location = scene["camera"]
towards = Vector(scene["look_at"]) - Vector(scene["camera"])
camera.rotation_euler = towards.to_track_quat("-Z", "Y").to_euler()
stage.camera = camera
bpy.ops.render.render(write_still=True)
sys.stdout.flush()
# Its own way out may crash in a program that is not its own.
os._exit(0)
