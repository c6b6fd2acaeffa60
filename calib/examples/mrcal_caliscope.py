"""mrcal on the corners and lenses of a caliscope project, beside `cargo run --example caliscope` (docs/benchmarks/calibration.md).

    /usr/bin/python3 calib/examples/mrcal_caliscope.py PROJECT      # Debian's python3-mrcal

Poses and boards are solved for, lenses stay. Prints the rms over all corners, rejected ones included, and the largest difference between the
cameras of two solves from every second set.
"""
import csv
import sys
import tomllib

import mrcal
import numpy as np

COLUMNS, ROWS, SQUARE_M = 3, 4, 0.054  # inner corners
LENS = "LENSMODEL_OPENCV5"

root = sys.argv[1]
with open(f"{root}/camera_array.toml", "rb") as file:
    cameras = tomllib.load(file)["cameras"]
ids = sorted(cameras)
sizes = np.array([cameras[i]["size"] for i in ids], dtype=np.int32)
lenses, poses = [], []
for i in ids:
    k = np.array(cameras[i]["matrix"])
    lenses.append([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *cameras[i]["distortions"][:5]])
    poses.append(np.vstack([np.array(cameras[i]["rotation"]), np.array(cameras[i]["translation"])]))
lenses = np.array(lenses)
from_first = np.array([mrcal.compose_Rt(pose, mrcal.invert_Rt(poses[0])) for pose in poses[1:]])

sets = {}
with open(f"{root}/calibration/extrinsic/xy.csv") as file:
    for row in list(csv.reader(file))[1:]:
        seen = sets.setdefault(int(row[0]), {}).setdefault(ids.index(row[1]), np.full((ROWS, COLUMNS, 3), -1.0))
        seen[int(row[5]) // COLUMNS, int(row[5]) % COLUMNS] = float(row[6]), float(row[7]), 1.0
shared = sorted(number for number, seen in sets.items() if len(seen) > 1)


def solve(numbers, outliers, warp):
    """The cameras against the first one (rt), and errors of all corners, pixels."""
    index = np.array([(f, c) for f, n in enumerate(numbers) for c in sorted(sets[n])], dtype=np.int32)
    seen = np.array([sets[n][c] for n in numbers for c in sorted(sets[n])])
    models = [(LENS, lens) for lens in lenses]
    boards = mrcal.estimate_monocular_calobject_poses_Rt_tocam(index, seen, SQUARE_M, models)
    boards = mrcal.estimate_joint_frame_poses(boards, from_first, index, COLUMNS, ROWS, SQUARE_M)
    boards = boards if boards.shape[-1] == 6 else mrcal.rt_from_Rt(boards)
    state = dict(
        intrinsics=lenses.copy(), extrinsics_rt_fromref=mrcal.rt_from_Rt(from_first), frames_rt_toref=boards.copy(),
        points=None, observations_board=seen.copy(), observations_point=None,
        indices_frame_camintrinsics_camextrinsics=np.array([(f, c, c - 1) for f, c in index], dtype=np.int32),
        indices_point_camintrinsics_camextrinsics=None, lensmodel=LENS, imagersizes=sizes,
        calibration_object_spacing=SQUARE_M, calobject_warp=np.zeros(2), do_optimize_intrinsics_core=False,
        do_optimize_intrinsics_distortions=False, do_optimize_extrinsics=True, do_optimize_frames=True,
        do_optimize_calobject_warp=warp, do_apply_regularization=False, do_apply_outlier_rejection=outliers,
        verbose=False,
    )
    mrcal.optimize(**state)
    board = mrcal.ref_calibration_object(COLUMNS, ROWS, SQUARE_M, calobject_warp=state["calobject_warp"] if warp else None)
    errors = []
    for (f, c), corners in zip(index, seen):
        point = mrcal.transform_point_rt(state["frames_rt_toref"][f], board)
        if c > 0:
            point = mrcal.transform_point_rt(state["extrinsics_rt_fromref"][c - 1], point)
        errors.append((mrcal.project(point, LENS, lenses[c]) - corners[..., :2])[corners[..., 2] > 0])
    return state["extrinsics_rt_fromref"], np.concatenate(errors)


def apart(a, b):
    """Degrees and millimetres between two poses."""
    a, b = mrcal.Rt_from_rt(a), mrcal.Rt_from_rt(b)
    turn = np.degrees(np.arccos(np.clip((np.trace(a[:3] @ b[:3].T) - 1) / 2, -1, 1)))
    return turn, 1e3 * np.linalg.norm(a[:3].T @ a[3] - b[:3].T @ b[3])


print(len(shared), "sets")
for name, outliers, warp in [("least squares", False, False), ("outliers rejected", True, False), ("and a bent board", True, True)]:
    errors = solve(shared, outliers, warp)[1]
    halves = [solve(shared[half::2], outliers, warp)[0] for half in (0, 1)]
    worst = np.max([apart(a, b) for a, b in zip(*halves)], axis=0)
    print(f"{name}: rms {np.sqrt((errors**2).sum(-1).mean()):.3f} px, halves {worst[0]:.3f} degrees, {worst[1]:.1f} mm")
