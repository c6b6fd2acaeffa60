#!/usr/bin/env python3
"""Runs the pose network on the same crops in ONNX Runtime, LiteRT and flyrig's own runtime; prints time and difference.

    python3.11 -m venv venv
    venv/bin/pip install onnxruntime==1.32.0 ai-edge-litert==2.3.0 pillow numpy
    venv/bin/pip download mediapipe==0.10.21 --no-deps
    venv/bin/python -m zipfile -e mediapipe-0.10.21-*.whl wheel
    venv/bin/python compare_runtimes.py wheel/mediapipe/modules/pose_landmark/pose_landmark_full.tflite IMAGE...

Each crop is the middle square of an image. Every runtime uses one thread. Times are medians over 20 rounds, with the least and
the most; differences are distances to LiteRT's world landmarks.
"""

import pathlib
import re
import subprocess
import sys
import tempfile
import time

import numpy as np
import onnxruntime
from ai_edge_litert.interpreter import Interpreter
from PIL import Image

ROUNDS = 20
HERE = pathlib.Path(__file__).resolve().parent


def crop(path):
    """Returns the middle square of an image, 256 x 256 x 3 in 0..=1."""
    picture = Image.open(path).convert("RGB")
    side = min(picture.size)
    left, top = (picture.width - side) // 2, (picture.height - side) // 2
    square = picture.crop((left, top, left + side, top + side)).resize((256, 256), Image.Resampling.BOX)
    return np.asarray(square, dtype=np.float32)[None] / 255.0


def timed(run, crops):
    """Returns the outputs of one round, and median, least and most milliseconds of all rounds."""
    found = [run(one) for one in crops]
    times = []
    for _ in range(ROUNDS):
        for one in crops:
            start = time.perf_counter()
            run(one)
            times.append(1e3 * (time.perf_counter() - start))
    return np.array(found), (np.median(times), min(times), max(times))


def litert(path, crops):
    interpreter = Interpreter(model_path=path, num_threads=1)
    interpreter.allocate_tensors()
    (entry,) = interpreter.get_input_details()
    landmarks = next(d["index"] for d in interpreter.get_output_details() if d["name"] == "Identity_4")

    def run(one):
        interpreter.set_tensor(entry["index"], one)
        interpreter.invoke()
        return interpreter.get_tensor(landmarks).reshape(39, 3)[:33]

    return timed(run, crops)


def onnx(crops):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(HERE / "pose_full.onnx"), options, ["CPUExecutionProvider"])
    entry = session.get_inputs()[0].name
    landmarks = [output.name for output in session.get_outputs()].index("world_landmarks")
    return timed(lambda one: session.run(None, {entry: one})[landmarks].reshape(39, 3)[:33], crops)


def own(crops):
    with tempfile.TemporaryDirectory() as folder:
        source, result = pathlib.Path(folder, "crops.f32"), pathlib.Path(folder, "landmarks.f32")
        np.concatenate(crops).astype("<f4").tofile(source)
        command = ["cargo", "bench", "--locked", "-p", "flyrig-tracker", "--bench", "network", "--", source, result]
        text = subprocess.run(command, cwd=HERE.parent, check=True, stdout=subprocess.PIPE, text=True).stdout
        found = np.fromfile(result, "<f4").reshape(len(crops), 33, 3)
    times = {name: tuple(map(float, rest.split())) for name, rest in re.findall(r"^([a-z ]+): ([\d. ]+)$", text, re.M)}
    return found, times


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    crops = [crop(path) for path in sys.argv[2:]]
    reference, of_litert = litert(sys.argv[1], crops)
    found, times = own(crops)
    rows = [
        ("LiteRT (XNNPACK)", "all", reference, of_litert),
        ("ONNX Runtime", "all", *onnx(crops)),
        ("flyrig", "all", found, times["all"]),
        ("flyrig", "no mask", found, times["no mask"]),
    ]
    print("| runtime | outputs | ms a crop: median, least, most | largest difference of a landmark, mm |\n|---|---|---|---|")
    for runtime, outputs, found, (median, least, most) in rows:
        difference = 1e3 * np.linalg.norm(found - reference, axis=-1).max()
        print(f"| {runtime} | {outputs} | {median:.1f} {least:.1f} {most:.1f} | {difference:.3f} |")


if __name__ == "__main__":
    main()
