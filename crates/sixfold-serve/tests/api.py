"""The API of `sixfold serve` driven by an ordinary Python client (the standard library), and its description validated.

    python3 crates/sixfold-serve/tests/api.py SIXFOLD DEMO

SIXFOLD is the program built with the feature `serve`, DEMO the folder data/demo. The description is validated where the package
`openapi-spec-validator` is installed; without it that part says that it is skipped. Exits with 1 at the first thing that is wrong.
"""

import json
import re
import signal
import subprocess
import sys
import tempfile
import urllib.error
import urllib.request
import uuid
from pathlib import Path


def request(url, data=None, headers=None, method=None):
    """Status and body; refused requests too."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data, headers or {}, method=method), timeout=120) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def post(url, texts, files):
    """Sends a multipart form."""
    boundary = uuid.uuid4().hex
    body = b""
    for name, value in texts.items():
        body += f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{value}\r\n'.encode()
    for name, path in files.items():
        head = f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="{path.name}"\r\n\r\n'
        body += head.encode() + path.read_bytes() + b"\r\n"
    body += f"--{boundary}--\r\n".encode()
    return request(url, body, {"Content-Type": f"multipart/form-data; boundary={boundary}"})


def result_of(address, path, texts, files):
    """Sends a form that becomes a job, and waits for its result."""
    status, body = post(address + path, texts, files)
    assert status == 202, (status, body)
    link = json.loads(body)["links"]["result"]
    status = 202
    while status == 202:
        status, body = request(f"{address}{link}?wait=30")
    assert status == 200, (status, body)
    return json.loads(body)


def check_description(address):
    status, body = request(f"{address}/v1/openapi.json")
    assert status == 200
    description = json.loads(body)
    # Each path that is described answers, with JSON where it refuses.
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            if method != "get" or path.endswith("openapi.json"):
                continue
            status, body = request(address + path.replace("{id}", "none").replace("{name}", "none"))
            assert str(status) in operation["responses"], (path, status)
            if status >= 400:
                assert set(json.loads(body)) == {"error", "field", "expected", "found", "advice"}, body
    try:
        from openapi_spec_validator import validate
    except ImportError:
        print("skipped: openapi-spec-validator is not installed, the description was not validated")
        return
    validate(description)
    print(f"the description is valid OpenAPI {description['openapi']}: {len(description['paths'])} paths")


def check_find(address, demo):
    mesh = demo / "models/obj_000009.ply"
    record = result_of(address, "/v1/objects", {"name": "duck", "unit": "mm"}, {"mesh": mesh})
    assert record["name"] == "duck" and abs(record["record"]["diameter"] - 0.109) < 0.002, record
    images = {
        "depth": demo / "test/000002/depth/000003.png",
        "rgb": demo / "test/000002/rgb/000003.png",
        "camera": demo / "camera.json",
    }
    found = result_of(address, "/v1/find", {"objects": "duck", "method": "ppf"}, images)
    (pose,) = found["poses"]
    with open(demo / "test/000002/scene_gt.json") as file:
        truth = next(p for p in json.load(file)["3"] if p["obj_id"] == 9)
    distance = sum((1000 * row[3] - t) ** 2 for row, t in zip(pose["camera_from_object"], truth["cam_t_m2c"])) ** 0.5
    assert distance < 10.9, f"{distance} mm from the ground truth, more than a tenth of the diameter"
    status, body = post(f"{address}/v1/find", {"objects": "teapot"}, images)
    assert status == 404 and json.loads(body)["field"] == "objects", (status, body)
    print(f"duck found {distance:.1f} mm from its ground truth, confidence {pose['confidence']:.2f}")


def main():
    program, demo = sys.argv[1], Path(sys.argv[2])
    with tempfile.TemporaryDirectory() as folder:
        command = [program, "serve", "--port", "0", "--store", f"{folder}/objects", "--data", f"{folder}/data"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                address = re.match(r"http://[\d.:]+", server.stdout.readline()).group()
                check_description(address)
                check_find(address, demo)
            finally:
                server.send_signal(signal.SIGINT)
            assert server.wait(timeout=30) == 0, "the server ends with 0 when it is interrupted"


if __name__ == "__main__":
    main()
