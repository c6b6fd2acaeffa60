#!/usr/bin/env python3
"""Opens a folder of `flyrig mesh` in Blender: vertices must lie where the files say, at rest, along the motion and with a bent elbow.

    python3.11 -m venv VENV && VENV/bin/pip install bpy==5.0.1 numpy scipy
    VENV/bin/python scripts/check-mesh-blender.py MESH_FOLDER [PICTURE.png]

Positions are computed here from the glTF file by linear blend skinning and compared with Blender's, of mesh.glb and of mesh.usdz. Then the
mesh is written as FBX and Alembic beside the picture, and rendered. Fails above 0.1 mm.
"""
import json, os, struct, sys, tempfile

import bpy
import numpy as np

TOLERANCE_M = 1e-4
failed = False


def report(what, distance_m, count):
    global failed
    bad = not distance_m <= TOLERANCE_M
    failed |= bad
    print(f"{what:40} {count:7} vertices, at most {1e3 * distance_m:.4f} mm {'FAILED' if bad else 'ok'}")


class Glb:
    """Skinned mesh of a glTF file, and its positions at any time and with any further turn of a joint."""

    def __init__(self, path):
        data = open(path, "rb").read()
        length = struct.unpack_from("<I", data, 12)[0]
        self.doc, self.bytes = json.loads(data[20:20 + length]), data[28 + length:]
        if "skins" not in self.doc:
            sys.exit(f"{path} has no bones: meshes of splat files are not rigged")
        skin, primitive = self.doc["skins"][0], self.doc["meshes"][0]["primitives"][0]["attributes"]
        self.points = self.read(primitive["POSITION"]).astype(float)
        self.joints, self.weights = self.read(primitive["JOINTS_0"]).astype(int), self.read(primitive["WEIGHTS_0"]).astype(float)
        self.weights /= self.weights.sum(1, keepdims=True)
        self.nodes = skin["joints"]
        self.inverse = self.read(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float)
        self.parent = {child: i for i, node in enumerate(self.doc["nodes"]) for child in node.get("children", [])}
        animations = self.doc.get("animations", [])
        self.samplers = {}
        for channel in (animations[0]["channels"] if animations else []):
            sampler = animations[0]["samplers"][channel["sampler"]]
            target = channel["target"]
            self.samplers[target["node"], target["path"]] = (self.read(sampler["input"]), self.read(sampler["output"]).astype(float))
        self.times = next(iter(self.samplers.values()))[0] if self.samplers else np.zeros(0)

    def read(self, accessor):
        a = self.doc["accessors"][accessor]
        view = self.doc["bufferViews"][a["bufferView"]]
        kind = {5126: "<f4", 5123: "<u2", 5125: "<u4", 5121: "u1"}[a["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[a["type"]]
        at = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        values = np.frombuffer(self.bytes, kind, a["count"] * width, at)
        return values if width == 1 else values.reshape(-1, width)

    def posed(self, key=None, bent=None):
        """Positions at a key, or at rest; `bent` is a node and a matrix that follows its rotation."""
        def local(node):
            description = self.doc["nodes"][node]
            turn, move = description.get("rotation", [0, 0, 0, 1]), description.get("translation", [0, 0, 0])
            if key is not None:
                turn = self.samplers.get((node, "rotation"), (0, [turn] * (key + 1)))[1][key]
                move = self.samplers.get((node, "translation"), (0, [move] * (key + 1)))[1][key]
            x, y, z, w = np.asarray(turn, float) / np.linalg.norm(turn)
            matrix = np.eye(4)
            matrix[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                              [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                              [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
            matrix[:3, 3] = move
            return matrix @ bent[1] if bent and bent[0] == node else matrix
        worlds = {}
        def world(node):
            if node not in worlds:
                worlds[node] = (world(self.parent[node]) if node in self.parent else np.eye(4)) @ local(node)
            return worlds[node]
        matrices = np.array([world(node) for node in self.nodes]) @ self.inverse
        homogeneous = np.c_[self.points, np.ones(len(self.points))]
        moved = np.einsum("vkij,vj->vki", matrices[self.joints], homogeneous)[..., :3]
        return (moved * self.weights[..., None]).sum(1)


def evaluated(y_up):
    """World positions of the only mesh that is drawn, with y up."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    drawn = [o for o in bpy.context.scene.objects if o.type == "MESH" and len(o.data.vertices) > 1000]
    assert len(drawn) == 1, [o.name for o in drawn]
    mine = drawn[0].evaluated_get(depsgraph)
    points = np.empty(3 * len(mine.data.vertices))
    mine.data.vertices.foreach_get("co", points)
    matrix = np.array(mine.matrix_world)
    points = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    # Blender has z up.
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], 1) if y_up else points


def farthest(points, expected):
    """Largest distance between vertices of the same index; of the nearest ones if a program merged some."""
    if len(points) == len(expected):
        return float(np.linalg.norm(points - expected, axis=1).max())
    from scipy.spatial import cKDTree
    return float(max(cKDTree(expected).query(points)[0].max(), cKDTree(points).query(expected)[0].max()))


def at_time(seconds):
    frame = seconds * bpy.context.scene.render.fps / bpy.context.scene.render.fps_base
    bpy.context.scene.frame_set(int(frame), subframe=float(frame % 1))


def render(path):
    scene = bpy.context.scene
    low, high = evaluated(False).min(0), evaluated(False).max(0)
    middle, size = (low + high) / 2, float((high - low).max())
    for kind, name in [("CAMERA", "camera"), ("LIGHT", "sun")]:
        data = bpy.data.cameras.new(name) if kind == "CAMERA" else bpy.data.lights.new(name, "SUN")
        thing = bpy.data.objects.new(name, data)
        scene.collection.objects.link(thing)
        if kind == "CAMERA":
            thing.location, thing.rotation_euler = middle + np.array([0, -2.6 * size, 0]), (np.pi / 2, 0, 0)
            scene.camera = thing
        else:
            data.energy, thing.rotation_euler = 3.0, (0.9, 0.2, 0.5)
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 16
    scene.render.resolution_x, scene.render.resolution_y = 480, 640
    scene.render.filepath = os.path.abspath(path)
    bpy.ops.render.render(write_still=True)


folder = sys.argv[1]
glb = Glb(os.path.join(folder, "mesh.glb"))
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=os.path.join(folder, "mesh.glb"), merge_vertices=False)
keys = sorted({0, len(glb.times) // 2, len(glb.times) - 1}) if len(glb.times) else []
for key in keys:
    at_time(glb.times[key])
    report(f"mesh.glb at {glb.times[key]:.2f} s", farthest(evaluated(True), glb.posed(key)), len(glb.points))
rig = next(o for o in bpy.context.scene.objects if o.type == "ARMATURE")
elbow = next(n for n, node in enumerate(glb.doc["nodes"]) if node.get("name", "") in ("elbow.L", "left_elbow", "lowerarm_l", "lowerarm01.L", "LeftForeArm"))
bone = rig.pose.bones[glb.doc["nodes"][elbow]["name"]]
before = glb.posed(keys[-1] if keys else None)
bone.rotation_mode = "QUATERNION"
# Turn of 60 degrees about the bone's own axis of Blender, which differs from the joint's by a fixed rotation.
import mathutils
rig.animation_data_clear()
for other in rig.pose.bones:
    other.matrix_basis.identity()
rest = bone.bone.matrix_local.to_3x3()
joint = np.linalg.inv(glb.inverse[glb.nodes.index(elbow)])[:3, :3]
to_blender = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
axis = np.array([1.0, 0.0, 0.0])
angle = np.radians(60)
bone.rotation_quaternion = mathutils.Quaternion(mathutils.Vector(np.array(rest.inverted()) @ to_blender @ joint @ axis), angle)
turn = np.eye(4)
turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
bpy.context.view_layer.update()
expected = glb.posed(None, (elbow, turn))
report("mesh.glb with a bent elbow", farthest(evaluated(True), expected), len(glb.points))
assert np.linalg.norm(expected - glb.posed(None), axis=1).max() > 0.05, "the elbow moves nothing"
out = os.path.dirname(os.path.abspath(sys.argv[2])) if len(sys.argv) > 2 else tempfile.mkdtemp()
if len(sys.argv) > 2:
    render(sys.argv[2])
bpy.ops.export_scene.fbx(filepath=os.path.join(out, "mesh.fbx"), path_mode="COPY", embed_textures=True)
bpy.ops.wm.alembic_export(filepath=os.path.join(out, "mesh.abc"))
for name in ["mesh.fbx", "mesh.abc"]:
    print(f"{name:40} {os.path.getsize(os.path.join(out, name)):7} bytes")
bpy.ops.wm.read_factory_settings(use_empty=True)
usdz = os.path.join(folder, "mesh.usdz")
bpy.ops.wm.usd_import(filepath=usdz, set_frame_range=True)
# Blender takes time codes as frames, and keeps its own frame rate.
bpy.utils.expose_bundled_modules()
from pxr import Usd
bpy.context.scene.render.fps, bpy.context.scene.render.fps_base = round(Usd.Stage.Open(usdz).GetTimeCodesPerSecond()), 1.0
for key in keys:
    at_time(glb.times[key])
    report(f"mesh.usdz at {glb.times[key]:.2f} s", farthest(evaluated(True), glb.posed(key)), len(glb.points))
sys.exit(failed)
