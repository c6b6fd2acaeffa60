#!/usr/bin/env python3
"""Converts landmark networks from MediaPipe's TFLite files to the ONNX files that flyrig-tracker embeds.

    python3.11 -m venv venv
    venv/bin/pip install tf2onnx==1.17.0 onnx==1.23.2 onnxruntime==1.31.1 tensorflow-cpu==2.21.0
    venv/bin/pip download mediapipe==0.10.21 --no-deps
    venv/bin/python -m zipfile -e mediapipe-0.10.21-*.whl wheel
    modules=wheel/mediapipe/modules
    venv/bin/python convert_mediapipe.py pose $modules/pose_landmark/pose_landmark_full.tflite pose_full.onnx
    npm pack @mediapipe/pose@0.5.1675469404 && tar xzf mediapipe-pose-*.tgz
    venv/bin/python convert_mediapipe.py pose package/pose_landmark_lite.tflite pose_lite.onnx
    venv/bin/python convert_mediapipe.py pose package/pose_landmark_heavy.tflite pose_heavy.onnx
    venv/bin/python convert_mediapipe.py hand $modules/hand_landmark/hand_landmark_lite.tflite hand_lite.onnx
    venv/bin/python convert_mediapipe.py face $modules/face_landmark/face_landmark.tflite face.onnx

The TFLite files store their weights as 16-bit floats. The converter widens them; this script narrows
them back (exactly, checked) behind a Cast, which halves the file. Only the outputs the tracker reads
are kept (OUTPUTS): handedness and world landmarks of the hand go.
The result is compared with the TFLite interpreter on random pictures.
"""

import argparse
import subprocess
import sys
import tempfile

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

# Outputs of each network in the TFLite file and their names here.
OUTPUTS = {
    # 39 landmarks x 5, one presence, 256x256 mask, 64x64 cells x 39 heatmaps (logits), 39 world landmarks x 3.
    "pose": {"Identity": "landmarks", "Identity_1": "presence", "Identity_2": "mask", "Identity_3": "heatmap", "Identity_4": "world_landmarks"},
    # 21 landmarks x 3, one presence. Left out: handedness, 21 world landmarks x 3.
    "hand": {"Identity": "landmarks", "Identity_1": "presence"},
    # 468 landmarks x 3, one presence logit.
    "face": {"conv2d_21": "landmarks", "conv2d_31": "presence"},
}


def keep_outputs(model, names):
    """Renames the wanted outputs and drops the rest with every node that only served them."""
    graph = model.graph
    wanted = []
    for value in list(graph.output):
        name = names.get(value.name)
        if name is not None:
            wanted.append((value.name, name, value))
    if len(wanted) != len(names):
        sys.exit(f"found outputs {[w[0] for w in wanted]} of {list(names)}; is this the right kind of network?")
    del graph.output[:]
    for old, new, value in wanted:
        for node in graph.node:
            for names in (node.input, node.output):
                for i, n in enumerate(names):
                    if n == old:
                        names[i] = new
        value.name = new
        graph.output.append(value)
    needed = {v.name for v in graph.output}
    kept = []
    for node in reversed(graph.node):
        if any(o in needed for o in node.output):
            kept.append(node)
            needed.update(node.input)
    del graph.node[:]
    graph.node.extend(reversed(kept))
    initializers = [t for t in graph.initializer if t.name in needed]
    del graph.initializer[:]
    graph.initializer.extend(initializers)
    del graph.value_info[:]


def narrow_weights(model):
    """Stores float weights as 16-bit floats where that loses nothing (relative 1e-3 at most)."""
    graph = model.graph
    casts, exact, total = [], 0, 0
    for tensor in list(graph.initializer):
        if tensor.data_type != TensorProto.FLOAT:
            continue
        wide = numpy_helper.to_array(tensor)
        if wide.size < 64:
            continue
        narrow = wide.astype(np.float16)
        error = np.abs(narrow.astype(np.float32) - wide).max()
        if error > 1e-3 * np.abs(wide).max():
            continue
        total += wide.size
        exact += int((narrow.astype(np.float32) == wide).sum())
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(narrow, name + "_f16"))
        casts.append(helper.make_node("Cast", [name + "_f16"], [name], to=TensorProto.FLOAT))
    nodes = casts + list(graph.node)
    del graph.node[:]
    graph.node.extend(nodes)
    print(f"{exact} of {total} weights are exact in 16 bits")


def compare(tflite_path, onnx_path, outputs):
    import onnxruntime
    import tensorflow as tf

    reference = tf.lite.Interpreter(model_path=tflite_path)
    reference.allocate_tensors()
    session = onnxruntime.InferenceSession(onnx_path)
    names = [o.name for o in session.get_outputs()]
    side = reference.get_input_details()[0]["shape"][1]
    random = np.random.default_rng(0)
    for _ in range(3):
        coarse = random.random((1, 8, 8, 3), dtype=np.float32)
        picture = np.repeat(np.repeat(coarse, side // 8, axis=1), side // 8, axis=2)
        reference.set_tensor(reference.get_input_details()[0]["index"], picture)
        reference.invoke()
        expected = {}
        for detail in reference.get_output_details():
            if detail["name"] in outputs:
                expected[outputs[detail["name"]]] = reference.get_tensor(detail["index"]).ravel()
        found = session.run(None, {session.get_inputs()[0].name: picture})
        for name, value in zip(names, found):
            error = np.abs(value.ravel() - expected[name]).max() / max(1.0, np.abs(expected[name]).max())
            print(f"{name}: largest difference to TFLite {error:.2e} of the largest value")
            if not error < 2e-3:
                sys.exit(f"{name} differs from TFLite by {error}; the conversion is wrong")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=OUTPUTS)
    parser.add_argument("tflite")
    parser.add_argument("onnx")
    arguments = parser.parse_args()
    with tempfile.NamedTemporaryFile(suffix=".onnx") as wide:
        command = [sys.executable, "-m", "tf2onnx.convert", "--tflite", arguments.tflite]
        subprocess.run([*command, "--opset", "13", "--output", wide.name], check=True)
        model = onnx.load(wide.name)
    keep_outputs(model, OUTPUTS[arguments.kind])
    narrow_weights(model)
    onnx.checker.check_model(model)
    onnx.save(model, arguments.onnx)
    compare(arguments.tflite, arguments.onnx, OUTPUTS[arguments.kind])


if __name__ == "__main__":
    main()
