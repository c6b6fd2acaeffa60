#!/usr/bin/env python3
"""Kills recordings at random moments and measures what they lost.

    scripts/kill-recording.py FLYRIG [COUNT=50] [COMMAND=run]

Runs `flyrig run RIG --record FILE` (or `flyrig record`) on a small simulated rig in real time, sends SIGKILL 1 to 4 s after the first frame,
and compares the time of the kill with that of the last frame in the file. Fails if more than 0.5 s of frames are missing, or if `flyrig
replay` does not read a file to its end.
"""
import os, random, signal, struct, subprocess, sys, tempfile, time

LIMIT_S = 0.5
FPS = 30
RIG = """[source]
kind = "sim"
path = "sim.toml"
real_time = true
cameras = ["00", "01"]
[perception]
pose = "given"
masks = "given"
[body]
gaussians = 1000
nodes = 50
[tracking]
solver = "off"
[transport]
listen = ["tcp/127.0.0.1:0"]
"""
SIM = f"width = 64\nheight = 64\ntexture_px = 64\nfps = {FPS}\nframes = 100000\ncameras.count = 2\n"


def frame_times(data):
    """Returns the times of the frames in a recording that may be cut off, seconds."""
    topics, times = {}, []

    def records(data, at):
        while at + 9 <= len(data):
            opcode, length = data[at], struct.unpack_from("<Q", data, at + 1)[0]
            if at + 9 + length > len(data):
                return
            yield opcode, data[at + 9 : at + 9 + length]
            at += 9 + length

    def read(opcode, body):
        if opcode == 6:
            size = struct.unpack_from("<I", body, 28)[0]
            for inner in records(body[40 + size :], 0):
                read(*inner)
        elif opcode == 4:
            channel, _, size = struct.unpack_from("<HHI", body)
            topics[channel] = body[8 : 8 + size].decode()
        elif opcode == 5:
            channel, _, nanos = struct.unpack_from("<HIQ", body)
            if topics.get(channel, "").startswith("camera/"):
                times.append(nanos * 1e-9)

    for record in records(data, 8):
        read(*record)
    return times


def one(flyrig, command, folder, number):
    path = os.path.join(folder, f"{number}.mcap")
    args = ["run", "rig.toml", "--record", path] if command == "run" else ["record", "rig.toml", "--out", path]
    log = open(os.path.join(folder, f"{number}.log"), "w")
    rig = subprocess.Popen([flyrig, *args], cwd=folder, stdout=log, stderr=log)
    until = time.monotonic() + 120
    while not (os.path.exists(path) and frame_times(open(path, "rb").read())):
        if rig.poll() is not None or time.monotonic() > until:
            sys.exit(f"the rig did not record; see {log.name}")
        time.sleep(0.1)
    # Frames of the simulator have a clock of their own. The least delay until a frame is in the file is its offset from ours.
    offset, end = float("inf"), time.monotonic() + random.uniform(1.5, 4)
    while time.monotonic() < end:
        last = max(frame_times(open(path, "rb").read()))
        offset = min(offset, time.monotonic() - last)
        time.sleep(0.01)
    killed = time.monotonic()
    rig.send_signal(signal.SIGKILL)
    rig.wait()
    times = frame_times(open(path, "rb").read())
    replay = subprocess.run([flyrig, "replay", path], capture_output=True, text=True)
    read = sum(int(line.split(": ")[1].split(" frames")[0]) for line in replay.stdout.splitlines() if line.startswith("camera "))
    is_read = replay.returncode == 0 and read == len(times)
    if is_read:
        os.remove(path)
    # Between two frames nothing can be lost.
    return max(0.0, killed - offset - max(times) - 1 / FPS), is_read


def main():
    flyrig, count = os.path.abspath(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 50
    command = sys.argv[3] if len(sys.argv) > 3 else "run"
    folder = tempfile.mkdtemp(prefix="kill-recording.")
    for name, text in [("rig.toml", RIG), ("sim.toml", SIM)]:
        with open(os.path.join(folder, name), "w") as file:
            file.write(text)
    results = [one(flyrig, command, folder, number) for number in range(count)]
    losses = sorted(loss for loss, _ in results)
    unread = sum(not is_read for _, is_read in results)
    print(f"{count} kills of flyrig {command}: lost {losses[0]:.2f} to {losses[-1]:.2f} s, median {losses[count // 2]:.2f} s; "
          f"{unread} files not read to their end")
    sys.exit(losses[-1] > LIMIT_S or unread > 0)


if __name__ == "__main__":
    main()
