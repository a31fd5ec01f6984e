"""The API of `sixfold serve` driven by an ordinary Python client (the standard library), and its description validated.

    cargo run --release -p sixfold-teach --example photographs -- data/demo/models/obj_000009.ply mm PHOTOGRAPHS
    python3 crates/sixfold-serve/tests/api.py SIXFOLD DEMO PHOTOGRAPHS

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
    for name, path in files.items() if isinstance(files, dict) else files:
        head = f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="{path.name}"\r\n\r\n'
        body += head.encode() + path.read_bytes() + b"\r\n"
    body += f"--{boundary}--\r\n".encode()
    return request(url, body, {"Content-Type": f"multipart/form-data; boundary={boundary}"})


def result_of(address, path, texts, files):
    """Sends a form that becomes a job, and waits for its result."""
    status, body = post(address + path, texts, files)
    assert status == 202, (status, body)
    return wait_for(address, json.loads(body))


def check_description(address):
    status, body = request(f"{address}/v1/openapi.json")
    assert status == 200
    description = json.loads(body)
    # Each path that is described answers, with JSON where it refuses.
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            if method != "get" or path.endswith("openapi.json"):
                continue
            status, body = request(address + re.sub(r"{\w+}", "none", path))
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


def wait_for(address, job):
    """The result of a job."""
    status = 202
    while status == 202:
        status, body = request(f"{address}{job['links']['result']}?wait=30")
    assert status == 200, (status, body)
    return json.loads(body)


def check_teach(address, photographs):
    files = [("photographs", path) for path in sorted((photographs / "photographs").iterdir())]
    files.append(("camera", photographs / "camera.json"))
    status, body = post(f"{address}/v1/teachings", {"name": "taught", "hull_only": "true"}, files)
    assert status == 201, (status, body)
    teaching = json.loads(body)
    link = teaching["links"]["teaching"]
    taught = wait_for(address, teaching["job"])
    assert taught["photographs"] == len(files) - 1 and taught["left_out"] == [], taught
    assert abs(taught["mesh"]["diameter"] - 0.109) < 0.006, taught["mesh"]
    # Nobody changed anything: the mask that there is, sent back, makes the mesh alone again.
    status, mask = request(f"{address}{link}/photographs/0/mask.png")
    assert status == 200
    status, body = request(f"{address}{link}/photographs/0/mask", mask, {"Content-Type": "image/png"}, "PUT")
    assert status == 200 and json.loads(body)["photographs"][0]["mask_by"] == "person", (status, body)
    status, body = request(f"{address}{link}/photographs/1/left_out", b'{"left_out": true}', method="PUT")
    assert status == 200, (status, body)
    status, body = request(f"{address}{link}/run", b"")
    assert status == 202, (status, body)
    assert wait_for(address, json.loads(body))["photographs"] == len(files) - 2
    status, body = request(f"{address}{link}/accept", b"")
    assert status == 202, (status, body)
    assert wait_for(address, json.loads(body))["object"] == "/v1/objects/taught"
    scene = {
        "depth": photographs / "scene/depth.png",
        "rgb": photographs / "scene/rgb.jpg",
        "camera": photographs / "camera.json",
    }
    found = result_of(address, "/v1/find", {"objects": "taught", "method": "ppf"}, scene)
    (pose,) = found["poses"]
    with open(photographs / "truth.json") as file:
        truth = json.load(file)["scene_camera_from_board"]
    # It stands on the board's origin, its middle 43 mm above.
    middle = [row[2] * 0.043 + row[3] for row in truth[:3]]
    distance = 1000 * sum((row[3] - t) ** 2 for row, t in zip(pose["camera_from_object"], middle)) ** 0.5
    assert distance < 15, f"{distance} mm from where it stands"
    print(f"an object taught from {len(files) - 2} photographs is found {distance:.1f} mm from where it stands")


def check_scale(address, photographs):
    """Photographs without a board are accepted before their scale is known; a run is not."""
    files = [("photographs", path) for path in sorted((photographs / "photographs").iterdir())[:3]]
    settings = {"name": "bare", "without_board": "true"}
    status, body = post(f"{address}/v1/teachings", settings, files)
    assert status == 422 and json.loads(body)["field"] == "length", (status, body)
    status, body = post(f"{address}/v1/teachings", settings | {"start": "false"}, files)
    assert status == 201, (status, body)
    link = json.loads(body)["links"]["teaching"]
    status, body = request(f"{address}{link}/run", b"")
    assert status == 409 and json.loads(body)["field"] == "length", (status, body)
    ends = [{"photograph": files[i][1].name, "points": [[100, 200], [300, 210.5]]} for i in (0, 2)]
    status, body = post(f"{address}{link}/photographs", {"length": 0.12, "ends": json.dumps(ends)}, [])
    teaching = json.loads(body)
    assert status == 200 and teaching["length"] == 0.12, (status, body)
    assert [end["photograph"] for end in teaching["ends"]] == [0, 2], teaching["ends"]
    assert request(f"{address}{link}", method="DELETE")[0] == 204


def main():
    program, demo, photographs = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    with tempfile.TemporaryDirectory() as folder:
        command = [program, "serve", "--port", "0", "--store", f"{folder}/objects", "--data", f"{folder}/data"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                address = re.match(r"http://[\d.:]+", server.stdout.readline()).group()
                check_description(address)
                check_scale(address, photographs)
                check_find(address, demo)
                check_teach(address, photographs)
            finally:
                server.send_signal(signal.SIGINT)
            assert server.wait(timeout=30) == 0, "the server ends with 0 when it is interrupted"


if __name__ == "__main__":
    main()
