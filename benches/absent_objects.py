"""How many objects a method reports in real frames that do not show them.

    python benches/absent_objects.py target/release/sixfold DIR [--out FILE] METHOD...

DIR holds lmo/, osd/, icbin_frames/ and meshes/ycb/. The eight objects of LM-O are searched in every fourth frame of OSD and in the first
frame of each bin of IC-BIN, scanned household objects in LM-O's frame with measured depth; none of these frames shows what is searched in
it. The same frame's own eight objects are searched too, and how many of them are reported is printed beside (right or wrong: see
`sixfold eval`). METHOD is a --method of `sixfold estimate`; each with its default threshold, given depth and colour. Standard library only."""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

BINS = {"fx": 550.0, "fy": 540.0, "cx": 316.0, "cy": 244.0, "width": 640, "height": 480, "depth_scale": 1.0}


def reported(binary, method, depth, rgb, camera, meshes):
    """Names of the objects that are reported, with their confidences."""
    command = [binary, "estimate", "--method", method, "--depth", depth, "--rgb", rgb, "--camera", camera, "--unit", "mm"]
    command += ["--object", *meshes, "--json"]
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if done.returncode not in (0, 1):
        sys.exit(f"{' '.join(map(str, command))}: {done.stderr}")
    return [(Path(p["object"]).stem, round(p["confidence"], 3)) for p in json.loads(done.stdout)["poses"]]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("methods", nargs="+")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    own = sorted((a.data / "lmo/models").glob("obj_*.ply"))
    others = sorted((a.data / "meshes/ycb").glob("*.ply"))
    scene = a.data / "lmo/test/000002"
    with tempfile.TemporaryDirectory() as folder:
        kinect, bins, lmo = Path(folder) / "osd.json", Path(folder) / "bins.json", a.data / "lmo/camera.json"
        k = json.loads((a.data / "osd/camera.json").read_text())["cam_K"]
        kinect.write_text(json.dumps({**BINS, "fx": k[0], "fy": k[4], "cx": k[2], "cy": k[5]}))
        bins.write_text(json.dumps(BINS))
        frames = [("lmo", scene / "depth/000003.png", scene / "rgb/000003.png", lmo, others)]
        osd = sorted(f for f in (a.data / "osd").iterdir() if f.is_dir())[::4]
        frames += [("osd", f / "depth.png", f / "rgb.png", kinect, own) for f in osd]
        frames += [
            ("icbin", a.data / f"icbin_frames/{b}/depth/0000.png", a.data / f"icbin_frames/{b}/rgb/0000.png", bins, own)
            for b in (1, 2, 3)
        ]
        whole = {}
        for method in a.methods:
            row = {"searched": 0, "reported": 0, "which": []}
            for name, depth, rgb, camera, meshes in frames:
                found = reported(a.binary, method, depth, rgb, camera, meshes)
                row["searched"] += len(meshes)
                row["reported"] += len(found)
                row["which"] += [f"{name} {depth.parent.name}: {n} {c}" for n, c in found]
                print(f"{method}: {name} {depth}: {len(found)} of {len(meshes)}", file=sys.stderr, flush=True)
            row["present_reported"] = len(reported(a.binary, method, *frames[0][1:4], own))
            row["present"] = len(own)
            whole[method] = row
    text = json.dumps(whole, indent=1)
    print(text)
    if a.out:
        a.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
