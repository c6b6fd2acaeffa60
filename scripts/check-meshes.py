#!/usr/bin/env python3
"""Opens mesh files that flyrig wrote with other programs and compares triangles and heights.

    cargo test --release -p flyrig-mesh --test samples
    python3 -m venv VENV && VENV/bin/pip install trimesh assimp-py lib3mf manifold3d usd-core numpy pillow lxml networkx
    VENV/bin/python scripts/check-meshes.py target/tmp/meshes

OBJ: trimesh, assimp. 3MF: lib3mf, trimesh, manifold3d. USDZ and USD sequence: OpenUSD with all of its validators. Prints one line per
check and fails if triangles or genus differ, heights by more than 1 mm, or a validator reports an error.
"""
import json, os, sys

import assimp_py, lib3mf, manifold3d, trimesh
import numpy as np
from pxr import Usd, UsdGeom, UsdSkel, UsdValidation

TOLERANCE_M = 1e-3
failed = False


def report(name, program, triangles, height_m, expected, height="height_m", faults=()):
    global failed
    bad = triangles != expected["triangles"] or abs(height_m - expected[height]) > TOLERANCE_M or bool(faults)
    failed |= bad
    print(f"{name:20} {program:24} {triangles:6} triangles {height_m:.4f} m {'FAILED' if bad else 'ok'}", *faults, sep="\n    ")


def check_obj(path, expected):
    name = os.path.basename(path)
    mesh = trimesh.load(path, force="mesh", process=False)
    image = mesh.visual.material.image
    faults = [] if image is not None and len(mesh.visual.uv) == len(mesh.vertices) else ["no texture"]
    report(name, "trimesh", len(mesh.faces), np.ptp(mesh.vertices[:, 1]), expected, faults=faults)
    # Colours are the coordinates: red grows with u, green with v downwards.
    uv, pixels = mesh.visual.uv, np.asarray(image, float) / 255
    at = pixels[((1 - uv[:, 1]) * (image.height - 1)).astype(int), (uv[:, 0] * (image.width - 1)).astype(int)]
    report(name, "trimesh: v is up", len(mesh.faces), expected["height_m"], expected,
           faults=[] if np.abs(at[:, :2] - np.stack([uv[:, 0], 1 - uv[:, 1]], 1)).max() < 0.02 else ["wrong texels"])
    scene = assimp_py.import_file(path, assimp_py.Process_Triangulate)
    points = np.asarray(scene.meshes[0].vertices).reshape(-1, 3)
    report(name, "assimp", len(np.asarray(scene.meshes[0].indices).reshape(-1, 3)), np.ptp(points[:, 1]), expected)


def check_3mf(path, expected):
    name = os.path.basename(path)
    model = lib3mf.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(path)
    meshes = model.GetMeshObjects()
    meshes.MoveNext()
    mesh = meshes.GetCurrentMeshObject()
    points = np.array([list(v.Coordinates) for v in mesh.GetVertices()])
    triangles = np.array([list(t.Indices) for t in mesh.GetTriangleIndices()])
    faults = [f"warning {reader.GetWarning(i)}" for i in range(reader.GetWarningCount())]
    faults += [] if mesh.IsManifoldAndOriented() and mesh.IsValid() else ["not manifold and oriented"]
    report(name, "lib3mf", len(triangles), np.ptp(points[:, 2]) / 1000, expected, faults=faults)
    solid = manifold3d.Manifold(manifold3d.Mesh(points.astype(np.float32), triangles.astype(np.uint32)))
    faults = [] if solid.status() == manifold3d.Error.NoError else [str(solid.status())]
    faults += [] if solid.genus() == expected["genus"] and solid.volume() > 0 else [f"genus {solid.genus()}"]
    box = solid.bounding_box()
    report(name, f"manifold3d {solid.status().name}", solid.num_tri(), (box[5] - box[2]) / 1000, expected, faults=faults)
    mesh = trimesh.load(path, force="mesh")
    faults = [] if mesh.is_watertight and mesh.is_winding_consistent else ["not watertight"]
    faults += [] if mesh.units == "millimeter" and abs(mesh.bounds[0]).max() < 1e-3 else ["not on the build plate"]
    report(name, "trimesh", len(mesh.faces), np.ptp(mesh.vertices[:, 2]) / 1000, expected, faults=faults)


def height(points):
    return float(np.ptp(np.asarray(points)[:, 1]))


def check_usd(path, expected):
    name = os.path.basename(path)
    stage = Usd.Stage.Open(path)
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    faults = [f"{error.GetType()}: {error.GetMessage()}" for error in context.Validate(stage)]
    faults += [] if UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Y" else ["units"]
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Root/Mesh"))
    triangles = len(mesh.GetFaceVertexCountsAttr().Get())
    report(name, f"OpenUSD {Usd.GetVersion()[1]}.{Usd.GetVersion()[2]:02}", triangles, height(mesh.GetPointsAttr().Get()), expected, faults=faults)
    last = stage.GetEndTimeCode()
    if path.endswith(".usda"):
        report(name, f"last frame, {last / stage.GetTimeCodesPerSecond():.2f} s", triangles, height(mesh.GetPointsAttr().Get(last)), expected, "last_height_m")
    elif "rigged" in name:
        UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetPrimAtPath("/Root")))
        report(name, f"skinned, {last / stage.GetTimeCodesPerSecond():.2f} s", triangles, height(mesh.GetPointsAttr().Get(last)), expected, "last_height_m")


folder = sys.argv[1]
for name, expected in json.load(open(os.path.join(folder, "expected.json"))).items():
    at = os.path.join(folder, name)
    check_obj(at + ".obj", expected)
    check_3mf(at + ".3mf", expected)
    for end in [".usdz", "-rigged.usdz", ".usda"]:
        check_usd(at + end, expected)
sys.exit(failed)
