#!/bin/sh
# What Pix2Pose learns from NOL's views, against renders of the vertex-coloured models, the real crops, and both (tables 4.3 to 4.5
# of the dissertation in our terms): two objects of LM-O, the same short training for all, the same test targets.
#
#   benches/pix2pose_from_nol.sh LMO PHOTOGRAPHS OUT [STEPS]
#
# LMO is a folder with LM-O, PHOTOGRAPHS one with photographs for backgrounds. Needs the program `sixfold` on the path and python3.
# About half an hour on two cores. Poses of NOL's sources are disturbed by up to 10 mm and 2.86 degrees about and along each axis
# first; the real crops keep their annotated poses.
set -e
LMO=$1 PHOTOGRAPHS=$2 OUT=$3 STEPS=${4:-1500}
HERE=$(cd "$(dirname "$0")/.." && pwd)
FRAMES=$HERE/data/lmo-training-frames.json
mkdir -p "$OUT"
python3 - "$LMO" "$FRAMES" "$OUT" <<'P'
import json, sys
lmo, frames, out = sys.argv[1:]
trained = {(t["scene_id"], t["im_id"]) for t in json.load(open(frames))}
targets = json.load(open(f"{lmo}/test_targets_bop19.json"))
kept = [t for t in targets if t["obj_id"] in (5, 8) and (t["scene_id"], t["im_id"]) not in trained]
json.dump(kept, open(f"{out}/targets.json", "w"))
print(len(kept), "targets")
P
SAME="--ids 5,8 --backgrounds $PHOTOGRAPHS --rotation 25 --size 96 --per-object 8 --steps $STEPS"
VIEWS="--dataset $LMO --frames $FRAMES --ids 5,8 --disturb 10,2.86 --step 10 --backgrounds $PHOTOGRAPHS"
sixfold synthesize $VIEWS --out "$OUT/views"
sixfold synthesize $VIEWS --no-refine --out "$OUT/views-unrefined"
sixfold train pix2pose --dataset "$LMO" --renders-only $SAME --out "$OUT/renders"
sixfold train pix2pose --dataset "$LMO" --frames "$FRAMES" --render-fraction 0 $SAME --out "$OUT/real"
sixfold train pix2pose --dataset "$LMO" --frames "$FRAMES" $SAME --out "$OUT/both"
sixfold train pix2pose --dataset "$OUT/views" --split train_nol --render-fraction 0 $SAME --out "$OUT/nol"
sixfold train pix2pose --dataset "$OUT/views-unrefined" --split train_nol --render-fraction 0 $SAME --out "$OUT/nol-unrefined"
for row in renders real both nol nol-unrefined; do
    sixfold estimate --method pix2pose --weights "$OUT/$row/model.safetensors" --dataset "$LMO" --boxes gt \
        --targets "$OUT/targets.json" --out "$OUT/$row.csv" > "$OUT/$row.log"
    echo "== $row"
    sixfold eval --dataset "$LMO" --results "$OUT/$row.csv" --targets "$OUT/targets.json"
done
