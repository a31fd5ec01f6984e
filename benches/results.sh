#!/usr/bin/env bash
# Freezes what the program computes, so that a change can be held against it: poses, scores, views and grasps as JSON,
# one file a part, each with the commands that made it. Times are left out: they are the only thing that may differ.
#
#   benches/results.sh [OPTIONS] SIXFOLD DATA OUT     run the parts into OUT/*.json
#   benches/results.sh --compare A B                  show what differs between two such folders (exit status 1)
#
# SIXFOLD is the program, DATA the folder with lmo/, meshes/, tabletop_objects/ (DIR in the commands that are written).
# A part whose file exists is kept, and so is each command that is done (in WORK): stopped, the same line goes on.
#
#   --parts A,B      only these parts (default: all but dgcm, teach and teach_depth, see below)
#   --threads N      threads of the program (default: 1; the values are the same for any number)
#   --work DIR       folder for what the commands write (OUT in the commands; default: out/results)
#   --commit NAME    what to write as the commit (default: git's HEAD); a work folder belongs to one commit
#
# Needs bash, python3, paths without spaces, and about 30 minutes of one core.
set -euo pipefail

PARTS=(evaluator demo single ppf_kinect ppf_xtion mttm_kinect mttm_xtion mttm_rows clutter pix2pose pix2pose_icp views auto detector detector_views grasp experience nol)
# Asked for by name only: chapter 6 in small, about eight minutes more; twelve objects taught from photographs, about 25; with depth, 40.
MORE=(dgcm teach teach_depth)

usage() {
    sed -n '2,/^set /{/^# \{0,1\}/s///p}' "${BASH_SOURCE[0]}"
    exit "${1:-2}"
}

# ---- comparing ----------------------------------------------------------------------------------------------------

compare() {
    python3 - "$1" "$2" <<'PY'
import json
import sys
from pathlib import Path

SHOWN = 20  # differences of a file


def leaves(value, path=""):
    """Every number and text of a JSON value, with where it stands."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from leaves(inner, f"{path}[{number}]")
    else:
        yield path, value


before, after = (Path(folder) for folder in sys.argv[1:])
names = sorted({p.name for folder in (before, after) for p in folder.glob("*.json")})
if not names:
    sys.exit(f"neither {before} nor {after} holds results (*.json)")
different = 0
for name in names:
    missing = [folder for folder in (before, after) if not (folder / name).exists()]
    if missing:
        different += 1
        print(f"{name}: not in {missing[0]}")
        continue
    a, b = (json.loads((folder / name).read_text()) for folder in (before, after))
    if a["command"] != b["command"]:
        print(f"{name}: note: the commands differ")
    if a["seed"] != b["seed"]:
        print(f"{name}: note: seed {a['seed']}, then {b['seed']}")
    a, b = dict(leaves(a["values"])), dict(leaves(b["values"]))
    lines = [f"  {k}: {a.get(k, 'nothing')} -> {b.get(k, 'nothing')}" for k in a | b if a.get(k, a) != b.get(k, b)]
    if not lines:
        print(f"{name}: {len(a)} values, the same")
    elif sorted(map(repr, a.values())) == sorted(map(repr, b.values())):
        print(f"{name}: {len(a)} values, the same under other names")
    else:
        different += 1
        print(f"{name}: {len(lines)} of {len(a | b)} values differ")
        print("\n".join(lines[:SHOWN] + ["  ..."] * (len(lines) > SHOWN)))
sys.exit(different > 0)
PY
}

# ---- options ------------------------------------------------------------------------------------------------------

threads=1 work="" commit="" chosen=("${PARTS[@]}")
while [[ ${1:-} == -* ]]; do
    case $1 in
    --help | -h) usage 0 ;;
    --compare)
        [ $# -eq 3 ] || usage
        compare "$2" "$3"
        exit
        ;;
    --parts) IFS=, read -ra chosen <<<"${2:-}" ;;
    --threads) threads=${2:-} ;;
    --work) work=${2:-} ;;
    --commit) commit=${2:-} ;;
    *) usage ;;
    esac
    shift 2 || usage
done
[ $# -eq 3 ] || usage
for part in "${chosen[@]}"; do
    [[ " ${PARTS[*]} ${MORE[*]} " == *" $part "* ]] || { echo "--parts: found $part, expected one of ${PARTS[*]} ${MORE[*]}" >&2; exit 2; }
done
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
program=$(realpath "$1")
data=$(realpath "$2")
mkdir -p "$3" "${work:=$root/out/results}"
out=$(realpath "$3")
work=$(realpath "$work")
cd "$root"
[ -x "$program" ] || { echo "$program is no program" >&2; exit 2; }
[ -d "$data/lmo/test" ] || { echo "$data holds no lmo/test" >&2; exit 2; }
: "${commit:=$(git rev-parse --short HEAD)}"
if [ "$(cat "$work/commit" 2>/dev/null || echo "$commit")" != "$commit" ]; then
    echo "$work was made at commit $(cat "$work/commit"): remove it or choose another --work" >&2
    exit 2
fi
echo "$commit" >"$work/commit"
# Two runs in one work folder would write the same files.
exec 9>"$work/lock"
if command -v flock >/dev/null && ! flock -n 9; then
    echo "another run uses $work: wait for it or choose another --work" >&2
    exit 2
fi
# Nothing that earlier runs have derived, and nothing left beside the user's files.
export XDG_CACHE_HOME=$work/cache SIXFOLD_STORE=$work/objects

# ---- running and keeping ------------------------------------------------------------------------------------------

commands=()

# Runs a command that is given as a reader would type it, DIR for the data and OUT for the work folder, unless it is done.
typed() {
    local done_file line
    commands+=("$1")
    done_file=$work/done/$(printf '%s' "$1" | sha256sum | cut -c1-16)
    [ -e "$done_file" ] && return
    line=${1//DIR\//$data/}
    line=${line//OUT\//$work/}
    [[ $line != sixfold\ * ]] || line="'$program' --threads $threads ${line#sixfold }"
    local status=0
    bash -c "$line" >"$work/log" 2>&1 </dev/null || status=$?
    # 1: it worked, but nothing was found.
    if [ "$status" -gt 1 ]; then
        echo "exit status $status of: $1" >&2
        tail -20 "$work/log" >&2
        exit 1
    fi
    mkdir -p "$work/done"
    : >"$done_file"
}

# Writes OUT/NAME.json from files: freeze NAME SEED KEY=FILE...
freeze() {
    WORK=$work DATA=$data ROOT=$root python3 - "$out/$1.json" "$commit" "$2" \
        "$(printf '%s\n' "${commands[@]}")" "${@:3}" <<'PY'
import csv
import hashlib
import json
import os
import re
import sys

TIME = re.compile(r"(^|_)(time|times|seconds|milliseconds)(_|$)")
LONG = {"curves", "parts", "segmentation"}  # kept as a checksum


def digest(text):
    return hashlib.sha256(text.encode()).hexdigest()


def kept(value):
    """The value without times, with the names of folders as in the commands."""
    if isinstance(value, dict):
        return {
            k: {"sha256": digest(json.dumps(v))} if k in LONG and isinstance(v, (dict, list)) else kept(v)
            for k, v in value.items()
            if not TIME.search(k)
        }
    if isinstance(value, list):
        return [kept(v) for v in value]
    if isinstance(value, str):
        for folder, name in (("WORK", "OUT"), ("DATA", "DIR")):
            value = value.replace(os.environ[folder], name)
        return value.replace(os.environ["ROOT"] + "/", "")
    return value


def content(path):
    if path.endswith(".csv"):
        with open(path, newline="") as file:
            head, *rows = csv.reader(file)
        wanted = [k for k, name in enumerate(head) if not TIME.search(name)]
        lines = [",".join(row[k] for k in wanted) for row in [head, *rows]]
        return {"sha256_without_time": digest("\n".join(lines)), "rows": lines}
    if path.endswith((".json", ".jsonl")):
        with open(path) as file:
            text = file.read()
        values = [json.loads(line) for line in text.splitlines()] if path.endswith("l") else json.loads(text)
        return kept(values)
    with open(path, "rb") as file:
        return {"sha256": hashlib.sha256(file.read()).hexdigest()}


path, commit, seed, commands, *files = sys.argv[1:]
values = {}
for file in files:
    key, _, name = file.partition("=")
    values[key] = content(os.path.join(os.environ["WORK"], name))
result = {"command": " && ".join(commands.splitlines()), "commit": commit, "seed": int(seed), "values": values}
text = json.dumps(result, indent=1)
# Rows of numbers on one line, or the files are long and hard to read.
text = re.sub(r"\[([^\[\]{}\"]*)\]", lambda m: "[" + " ".join(m[1].split()) + "]", text)
with open(path + ".new", "w") as file:
    file.write(text + "\n")
os.replace(path + ".new", path)
PY
}

# Frames to measure on, as targets files: every eighth of LM-O, and every eighth that no training used.
write_targets() {
    python3 - "$data/lmo/test_targets_bop19.json" data/lmo-training-frames.json "$work" <<'PY'
import json
import sys

targets, training, folder = sys.argv[1:]
with open(targets) as file:
    targets = json.load(file)
with open(training) as file:
    training = {(f["scene_id"], f["im_id"]) for f in json.load(file)}


def frame(target):
    return target["scene_id"], target["im_id"]


def write(name, frames):
    chosen = set(sorted(frames)[::8])
    with open(f"{folder}/{name}", "w") as file:
        json.dump([t for t in targets if frame(t) in chosen], file, indent=1)


write("every-8th.json", {frame(t) for t in targets})
write("every-8th-untrained.json", {frame(t) for t in targets} - training)
PY
}

images() { python3 -c 'import json, sys; print(",".join(str(i) for i in sorted({t["im_id"] for t in json.load(open(sys.argv[1]))})))' "$1"; }

# ---- parts --------------------------------------------------------------------------------------------------------

# The evaluator on published estimates.
part_evaluator() {
    typed "sixfold eval --dataset DIR/lmo --results DIR/lmo/published/cnos-fastsam-megapose_lmo-test.csv --detection-ap --no-vsd --json OUT/evaluator.json"
    freeze evaluator 0 megapose=evaluator.json
}

# The sample frames: poses from depth and from colour, the demo's table.
part_demo() {
    typed "sixfold demo --out OUT/demo --json OUT/demo.json"
    freeze demo 0 demo=demo.json
}

# One image: poses with all their digits, by every method, and grasps of two objects.
part_single() {
    local one=OUT/samples/test/000002 other=OUT/samples/test/001002 model=OUT/samples/models/obj_0000
    typed "cp -r data/demo OUT/samples"
    typed "sixfold estimate --method ppf --depth $one/depth/000003.png --camera OUT/samples/camera.json --object ${model}08.ply ${model}09.ply --unit mm --out OUT/single-ppf --json OUT/single-ppf.json"
    typed "sixfold estimate --method mttm --depth $other/depth/000248.png --camera OUT/samples/camera.json --object ${model}05.ply --unit mm --out OUT/single-mttm --json OUT/single-mttm.json"
    typed "sixfold estimate --method mttm --matcher points --templates-only --depth $other/depth/000248.png --camera OUT/samples/camera.json --object ${model}05.ply --unit mm --out OUT/single-templates --json OUT/single-templates.json"
    typed "sixfold estimate --method pix2pose --weights weights/pix2pose-lmo.safetensors --object-id 8 --rgb $one/rgb/000003.png --camera OUT/samples/camera.json --object ${model}08.ply --unit mm --box 330,120,110,150 --out OUT/single-pix2pose --json OUT/single-pix2pose.json"
    typed "sixfold detect --weights weights/detector-lmo.safetensors --rgb $one/rgb/000003.png --out OUT/single-detect --json OUT/single-detect.json"
    freeze single 0 ppf=single-ppf.json mttm=single-mttm.json templates=single-templates.json \
        pix2pose=single-pix2pose.json detect=single-detect.json
}

# LM-O's frames with a simulated sensor's depth.
simulate() {
    typed "sixfold simulate-depth --dataset DIR/lmo --sensor $1 --images $(images "$work/every-8th.json") --out OUT/sim-$1"
}

# One run over the simulated frames, and its scores: by_depth SENSOR NAME OPTIONS
by_depth() {
    typed "sixfold estimate --dataset OUT/sim-$1 --targets OUT/every-8th.json $3 --out OUT/$2-$1.csv"
    typed "sixfold eval --dataset OUT/sim-$1 --targets OUT/every-8th.json --results OUT/$2-$1.csv --json OUT/$2-$1.json"
}

# Point pair features, in the whole image and in boxes.
ppf() {
    simulate "$1"
    by_depth "$1" ppf "--method ppf"
    by_depth "$1" ppf-boxes "--method ppf --boxes gt"
    freeze "ppf_$1" 0 "poses=ppf-$1.csv" "scores=ppf-$1.json" "poses_in_boxes=ppf-boxes-$1.csv" "scores_in_boxes=ppf-boxes-$1.json"
}
part_ppf_kinect() { ppf kinect; }
part_ppf_xtion() { ppf xtion; }

# Templates, matched by network and points, and by points alone.
mttm() {
    simulate "$1"
    by_depth "$1" mttm "--method mttm"
    by_depth "$1" mttm-points "--method mttm --matcher points"
    by_depth "$1" mttm-boxes "--method mttm --boxes gt"
    freeze "mttm_$1" 0 "poses=mttm-$1.csv" "scores=mttm-$1.json" \
        "poses_by_points=mttm-points-$1.csv" "scores_by_points=mttm-points-$1.json" \
        "poses_in_boxes=mttm-boxes-$1.csv" "scores_in_boxes=mttm-boxes-$1.json"
}
part_mttm_kinect() { mttm kinect; }
part_mttm_xtion() { mttm xtion; }

# Every way of template matching, side by side.
part_mttm_rows() {
    simulate xtion
    typed "sixfold reproduce mttm --dataset OUT/sim-xtion --targets OUT/every-8th.json --every 4 --out OUT/mttm-rows --json OUT/mttm-rows.json"
    freeze mttm_rows 0 rows=mttm-rows.json
}

# Piles: templates from above and from all sides, and point pair features. No setting was chosen on the scenes of this seed.
part_clutter() {
    local name method scenes=OUT/clutter
    typed "sixfold simulate-scenes --dataset DIR/lmo --scenes 4 --views 2 --stacked 1 --objects-per-scene 10,14 --sensor xtion --seed 11 --out $scenes"
    for name in ppf above around; do
        method="mttm --templates $name"
        [ "$name" != ppf ] || method=ppf
        typed "sixfold estimate --method $method --dataset $scenes --out OUT/clutter-$name.csv"
        typed "sixfold eval --dataset $scenes --no-vsd --results OUT/clutter-$name.csv --json OUT/clutter-$name.json"
    done
    freeze clutter 11 poses_ppf=clutter-ppf.csv scores_ppf=clutter-ppf.json poses_above=clutter-above.csv scores_above=clutter-above.json \
        poses_around=clutter-around.csv scores_around=clutter-around.json
}

# Probabilities: simulated scenes that were not fitted to, with absent objects, and the sample images; poses beside those of the single
# methods (ppf_kinect, and templates in the same images).
part_auto() {
    local scenes=OUT/auto-scenes
    simulate kinect
    by_depth kinect auto ""
    typed "sixfold simulate-scenes --families all --members 2 --toys 10 --scenes 32 --views 1 --sensor xtion --seed 202 --no-masks --out $scenes"
    typed "sixfold reproduce auto --dataset $scenes --absent 6 --disturb --given depth --out OUT/auto-depth --json OUT/auto-depth.json"
    typed "sixfold reproduce auto --dataset data/demo --given depth both --out OUT/auto-demo --json OUT/auto-demo.json"
    freeze auto 202 simulated=auto-depth.json samples=auto-demo.json poses_kinect=auto-kinect.csv scores_kinect=auto-kinect.json
}

# Objects taught from simulated photographs.
part_teach() {
    local common="sixfold reproduce teach --list benches/teach-objects.json --meshes DIR/meshes --ground DIR/backgrounds/103041.jpg --out OUT/teach"
    typed "$common --json OUT/teach.json"
    freeze teach 7 taught=teach.json
}

# The same objects with depth, and from one view with depth.
part_teach_depth() {
    local common="sixfold reproduce teach --list benches/teach-objects.json --meshes DIR/meshes --ground DIR/backgrounds/103041.jpg --out OUT/teach"
    typed "$common --depth --json OUT/teach-depth.json"
    typed "$common --one-view --json OUT/teach-one-view.json"
    freeze teach_depth 7 with_depth=teach-depth.json one_view=teach-one-view.json
}

# Poses from colour in ground-truth boxes and in a detector's.
part_pix2pose() {
    local common="--dataset DIR/lmo --targets OUT/every-8th-untrained.json" model="--method pix2pose --weights weights/pix2pose-lmo.safetensors"
    typed "sixfold estimate $model $common --boxes gt --out OUT/pix2pose.csv"
    typed "sixfold eval $common --no-vsd --results OUT/pix2pose.csv --json OUT/pix2pose.json"
    typed "sixfold estimate $model $common --detector weights/detector-lmo.safetensors --out OUT/pix2pose-detected.csv"
    typed "sixfold eval $common --no-vsd --results OUT/pix2pose-detected.csv --json OUT/pix2pose-detected.json"
    freeze pix2pose 0 poses=pix2pose.csv scores=pix2pose.json \
        poses_in_detected_boxes=pix2pose-detected.csv scores_in_detected_boxes=pix2pose-detected.json
}

# Tables 3.7 and 3.8: colour alone and with ICP, as published and ours, on simulated depth in ground-truth boxes.
part_pix2pose_icp() {
    local name options files=() frames=OUT/sim-rgbd model="--method pix2pose --weights weights/pix2pose-lmo.safetensors"
    local common="--dataset $frames --targets OUT/every-8th-untrained.json"
    typed "sixfold simulate-depth --dataset DIR/lmo --sensor kinect --rgb --images $(images "$work/every-8th-untrained.json") --out $frames"
    for name in published published_icp ours ours_icp; do
        options=""
        [[ $name != published* ]] || options+=" --preset published"
        [[ $name != *_icp ]] || options+=" --icp"
        typed "sixfold estimate $model$options $common --boxes gt --out OUT/pix2pose-$name.csv"
        typed "sixfold eval $common --results OUT/pix2pose-$name.csv --json OUT/pix2pose-$name.json"
        files+=("scores_$name=pix2pose-$name.json" "poses_$name=pix2pose-$name.csv")
    done
    freeze pix2pose_icp 0 "${files[@]}"
}

# Poses from colour without training for the object, in ground-truth boxes of all targets.
part_views() {
    typed "sixfold estimate --method views --dataset DIR/lmo --boxes gt --out OUT/views.csv"
    typed "sixfold eval --dataset DIR/lmo --no-vsd --results OUT/views.csv --json OUT/views.json"
    freeze views 0 poses=views.csv scores=views.json
}

# Boxes and masks, and their average precision.
part_detector() {
    local common="--dataset DIR/lmo --targets OUT/every-8th-untrained.json"
    typed "sixfold detect --weights weights/detector-lmo.safetensors $common --out OUT/detections.json"
    typed "sixfold eval $common --detections OUT/detections.json --json OUT/detector.json"
    # The ten best of each file's detections stand for all in the repository; the checksum covers every one.
    python3 - "$work/detections.json" "$work/detections-best.json" <<'PY'
import hashlib
import json
import sys

found = [{k: v for k, v in d.items() if k != "time"} for d in json.load(open(sys.argv[1]))]
best = sorted(found, key=lambda d: -d["score"])[:10]
digest = hashlib.sha256(json.dumps(found).encode()).hexdigest()
json.dump({"count": len(found), "sha256_without_time": digest, "best": best}, open(sys.argv[2], "w"))
PY
    freeze detector 0 scores=detector.json detections=detections-best.json
}

# Boxes and masks without training, by poses and by names of the proposals only.
part_detector_views() {
    local common="--dataset DIR/lmo" way
    for way in views quick; do
        typed "sixfold detect --method views $common$([ $way = quick ] && echo " --quick") --out OUT/detections-$way.json"
        typed "sixfold eval $common --detections OUT/detections-$way.json --min-score 0.5 --json OUT/detector-$way.json"
    done
    freeze detector_views 0 views=detector-views.json quick=detector-quick.json
}

# Grasps of real objects from one depth image, and how often the first one holds in simulation.
part_grasp() {
    local object input
    for object in blue_mug mustard; do
        input="--depth DIR/tabletop_objects/$object/depth.png --mask DIR/tabletop_objects/$object/mask.png --camera DIR/tabletop_objects/$object/camera.json"
        typed "sixfold grasp propose $input --out OUT/grasp-$object --json OUT/grasp-$object.json"
    done
    typed "sixfold grasp measure --list benches/grasp-objects.json --meshes DIR/meshes --trials 2 --out OUT/grasp-measure --json OUT/grasp-measure.json"
    freeze grasp 0 blue_mug=grasp-blue_mug.json mustard=grasp-mustard.json measured=grasp-measure.json
}

# Experience collected in simulation, and grasps transferred from it to real objects.
part_experience() {
    local object input
    typed "sixfold grasp learn --experiences OUT/experience.db --families can,mug --members 1 --tries 1 --attempts 2 --explore 2 --near 0 --out OUT/learn --json OUT/learn.json"
    typed "sixfold grasp store list OUT/experience.db --json OUT/experience.json"
    for object in blue_mug mustard; do
        input="--depth DIR/tabletop_objects/$object/depth.png --mask DIR/tabletop_objects/$object/mask.png --camera DIR/tabletop_objects/$object/camera.json"
        typed "sixfold grasp propose $input --experiences OUT/experience.db --out OUT/experience-$object --json OUT/experience-$object.json"
    done
    freeze experience 0 learned=learn.json stored=experience.json blue_mug=experience-blue_mug.json mustard=experience-mustard.json
}

# Poses of few photographs and views made of them.
part_nol() {
    typed "sixfold reproduce nol --dataset DIR/lmo --frames data/lmo-training-frames.json --weights crates/sixfold-nol/weights/nol-compact.safetensors --quick --out OUT/nol --json OUT/nol.json"
    freeze nol 0 reproduced=nol.json
}

# Grasps from experience, at the size that shows what there is to see.
part_dgcm() {
    typed "sixfold reproduce dgcm --list benches/grasp-objects.json --meshes DIR/meshes --quick --out OUT/dgcm --json OUT/dgcm.json"
    freeze dgcm 0 reproduced=dgcm.json
}

write_targets
for part in "${chosen[@]}"; do
    if [ -e "$out/$part.json" ]; then
        echo "$part: kept"
        continue
    fi
    began=$SECONDS
    commands=()
    "part_$part"
    echo "$part: $((SECONDS - began)) s"
done
