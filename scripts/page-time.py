#!/usr/bin/env python3
"""Measures how long the page of a running rig takes until it shows the person with all colours.

    scripts/page-time.py [PORT=8080] [--mbit 3] [--runs 5]

Each run starts Chromium without a window, drawn by its software adapter, and counts from the opening of the page. --mbit passes what the rig
sends through a line of that rate.
"""
import argparse, json, os, socket, statistics, subprocess, tempfile, threading, time

OPTIONS = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-pipe"]
PACKET = 1500
LIMIT_S = 60


class Chromium:
    """A browser that is controlled through two pipes."""

    def __init__(self, folder):
        (their_in, our_out), (our_in, their_out) = os.pipe(), os.pipe()

        def inherit():
            # Twice, because either descriptor may have the number of the other.
            low, high = os.dup(their_in), os.dup(their_out)
            os.dup2(low, 3)
            os.dup2(high, 4)

        arguments = ["chromium", *OPTIONS, f"--user-data-dir={folder}", "about:blank"]
        self.process = subprocess.Popen(arguments, preexec_fn=inherit, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(their_in)
        os.close(their_out)
        self.requests, self.answers, self.count, self.session = our_out, os.fdopen(our_in, "rb"), 0, None
        pages = [target for target in self.call("Target.getTargets")["targetInfos"] if target["type"] == "page"]
        self.session = self.call("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)["sessionId"]

    def call(self, method, **parameters):
        self.count += 1
        request = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            request["sessionId"] = self.session
        os.write(self.requests, json.dumps(request).encode() + b"\0")
        while True:
            text = b""
            while not text.endswith(b"\0"):
                byte = self.answers.read(1)
                if not byte:
                    raise SystemExit("Chromium ended")
                text += byte
            answer = json.loads(text[:-1])
            if answer.get("id") == self.count:
                return answer.get("result", {})

    def state(self):
        """Returns what the page says of itself."""
        value = self.call("Runtime.evaluate", expression="JSON.stringify(document.documentElement.dataset)")
        return json.loads(value.get("result", {}).get("value") or "{}")


def one(port):
    """Returns the seconds until the first image and until all colours."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        browser = Chromium(folder)
        try:
            begun, first = time.monotonic(), None
            browser.call("Page.navigate", url=f"http://127.0.0.1:{port}/")
            while time.monotonic() < begun + LIMIT_S:
                state, elapsed = browser.state(), time.monotonic() - begun
                if first is None and int(state.get("frame", 0)) > 0:
                    first = elapsed
                if state.get("ready") == "yes":
                    return first, elapsed
                time.sleep(0.02)
            raise SystemExit(f"no person with all colours within {LIMIT_S} s")
        finally:
            browser.process.kill()
            browser.process.wait()


def line(port, bits_per_second):
    """Listens on a port of its own, and passes on what arrives there; returns the port."""
    lock, free = threading.Lock(), [0.0]

    def pass_on(source, to, is_slow):
        try:
            while data := source.recv(PACKET):
                if is_slow:
                    with lock:
                        free[0] = max(free[0], time.monotonic()) + 8 * len(data) / bits_per_second
                        left = free[0] - time.monotonic()
                    time.sleep(max(0, left))
                to.sendall(data)
        except OSError:
            pass
        for end in (source, to):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass

    def accept():
        while True:
            client, _ = listener.accept()
            server = socket.socket()
            # What waits in the line is held back by the sender, as on a real one.
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
            server.connect(("127.0.0.1", port))
            for ends in ((client, server, False), (server, client, True)):
                threading.Thread(target=pass_on, args=ends, daemon=True).start()

    listener = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=accept, daemon=True).start()
    return listener.getsockname()[1]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("port", type=int, nargs="?", default=8080)
    parser.add_argument("--mbit", type=float, help="rate of the line, Mbit/s")
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    port = line(arguments.port, 1e6 * arguments.mbit) if arguments.mbit else arguments.port
    runs = [one(port) for _ in range(arguments.runs)]
    for what, seconds in zip(("first image", "all colours"), zip(*runs)):
        seconds = [value for value in seconds if value is not None]
        print(f"{what}: median {statistics.median(seconds):.2f} s, {min(seconds):.2f} to {max(seconds):.2f} s from opening the page")


if __name__ == "__main__":
    main()
