"""Clients of `sixfold serve` on this machine: the first and the second request for one object, then several clients at once.

    cargo build --release -p sixfold-cli --features serve
    python3 benches/serve_clients.py target/release/sixfold --seconds 60 --clients 8

Everything runs on the loopback address, for `--seconds` at most and at most `--requests` requests. Each client asks for one of four
objects in data/demo's frame 3 by point pair features; the answer has to be the one that a single client got before. Needs the standard
library alone. Exits with 1 where an answer is wrong.
"""

import argparse
import json
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "crates/sixfold-serve/tests"))
from api import result_of  # noqa: E402

DEMO = ROOT / "data/demo"
OBJECTS = {"ape": 1, "cat": 6, "driller": 8, "duck": 9}
IMAGES = {
    "depth": DEMO / "test/000002/depth/000003.png",
    "rgb": DEMO / "test/000002/rgb/000003.png",
    "camera": DEMO / "camera.json",
}


def find(address, name):
    began = time.monotonic()
    result = result_of(address, "/v1/find", {"objects": name, "method": "ppf"}, IMAGES)
    poses = [(p["object"], p["camera_from_object"]) for p in result["poses"]]
    return poses, time.monotonic() - began, result["seconds"]


def many(address, expected, arguments):
    """Each client asks one request after the other until the time is over."""
    times, wrong, lock = [], [], threading.Lock()
    end = time.monotonic() + arguments.seconds

    def client(number):
        names = list(OBJECTS)
        turn = number
        while time.monotonic() < end:
            with lock:
                if len(times) + len(wrong) >= arguments.requests:
                    return
            name = names[turn % len(names)]
            turn += 1
            try:
                poses, seconds, _ = find(address, name)
            except Exception as error:  # the count of errors is the result
                with lock:
                    wrong.append(f"{name}: {error}")
                continue
            with lock:
                (times if poses == expected[name] else wrong).append(seconds)

    began = time.monotonic()
    threads = [threading.Thread(target=client, args=(i,)) for i in range(arguments.clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return times, wrong, time.monotonic() - began


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("--clients", type=int, default=8, choices=range(1, 65))
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--requests", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, number in OBJECTS.items():
            mesh = DEMO / f"models/obj_{number:06}.ply"
            add = ["object", "add", name, str(mesh), "--unit", "mm", "--store", f"{folder}/objects"]
            subprocess.run([arguments.program, *add], check=True, stdout=subprocess.DEVNULL)
        command = [arguments.program, "serve", "--port", "0", "--store", f"{folder}/objects", "--data", f"{folder}/data"]
        command += ["--workers", str(arguments.workers)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                address = re.match(r"http://[\d.:]+", server.stdout.readline()).group()
                first, second = find(address, "driller"), find(address, "driller")
                assert first[0] == second[0], "the same question has the same answer"
                expected = {name: find(address, name)[0] for name in OBJECTS}
                times, wrong, wall = many(address, expected, arguments)
            finally:
                server.send_signal(signal.SIGINT)
    report = {
        "first request (s)": round(first[1], 3),
        "second request (s)": round(second[1], 3),
        "work of the second (s)": round(second[2], 3),
        "clients": arguments.clients,
        "workers": arguments.workers,
        "answers": len(times),
        "wrong or failed": len(wrong),
        "wall (s)": round(wall, 1),
        "answers a second": round(len(times) / wall, 2),
        "median (s)": round(statistics.median(times), 2) if times else None,
        "longest (s)": round(max(times), 2) if times else None,
    }
    print(json.dumps(report, indent=2))
    for fault in wrong[:5]:
        print(fault, file=sys.stderr)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
