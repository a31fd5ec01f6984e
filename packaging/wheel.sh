#!/usr/bin/env bash
# Builds the wheel, with the samples and weights in it. Needs Rust, and Python with venv and pip.
#
#   packaging/wheel.sh [OUT]       default: out/packages
set -euo pipefail
if [ $# -gt 1 ] || [[ ${1:-} == -* ]]; then
    sed -n '2,/^set /{/^#/s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}"
    exit 2
fi
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
mkdir -p "${1:-$root/out/packages}"
out=$(cd "${1:-$root/out/packages}" && pwd)
cd "$root/python"
scratch=$(mktemp -d)
# The folder is in no commit: it is here while the wheel is built.
share=$root/python/package/sixfold/share
trap 'rm -rf "$scratch" "$share"' EXIT
rm -rf "$share"
mkdir -p "$share"
cp -r ../data/demo "$share/demo"
cp -r ../weights "$share/weights"
python3 ../packaging/licences.py "$(rustc -vV | sed -n 's/^host: //p')" sixfold-python >"$share/THIRD-PARTY.txt"

python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet 'maturin>=1.9,<2'
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)} "$scratch/venv/bin/maturin" build --release --locked --out "$out"

# In an environment of its own, outside the repository, without Rust: import, the README's example, colour, grasps.
python3 -m venv "$scratch/clean"
"$scratch/clean/bin/pip" install --quiet "$out"/sixfold-*-abi3-*.whl
mkdir "$scratch/here" "$scratch/home"
cd "$scratch/here"
env -i HOME="$scratch/home" PATH="$scratch/clean/bin:/usr/bin:/bin" python - <<'PY'
import shutil

import numpy as np
import sixfold

assert shutil.which("cargo") is None and shutil.which("rustc") is None
demo = sixfold.shipped("demo")
assert "site-packages" in str(demo), demo
dataset = sixfold.bop.Dataset(demo)
found = sixfold.estimate_ppf(dataset.depth(2, 3), dataset.model(8), dataset.camera(2, 3))
print("estimate_ppf", found[0].confidence, found[0].camera_from_object[:3, 3])
rgb = dataset.rgb(2, 3)
detector = sixfold.Detector.load(sixfold.shipped("weights/detector-lmo.safetensors"))
print("Detector", [(d.object_id, round(float(d.score), 2)) for d in detector(rgb)])
pix2pose = sixfold.Pix2Pose.load(sixfold.shipped("weights/pix2pose-lmo.safetensors"), camera=dataset.camera(2, 3))
network = sixfold.DgcmNet.load(sixfold.shipped("weights/dgcm.safetensors"))
grasps = sixfold.propose_grasps(dataset.depth(2, 3), dataset.camera(2, 3))
print("propose_grasps", len(grasps))
assert found and found[0].confidence > 0.5 and len(grasps) > 0 and isinstance(rgb, np.ndarray)
print("sixfold", sixfold.__version__, "from the wheel")
PY
