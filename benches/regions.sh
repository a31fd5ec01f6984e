#!/usr/bin/env bash
# Milliseconds of `sixfold estimate --boxes FILE` for 1, 8 and 30 regions of one image, by point pair features and by
# templates: what it costs to look into one more region of an image that is prepared already.
#
#   benches/regions.sh SIXFOLD DATA [RUNS]
#
# SIXFOLD is the program, DATA the folder with lmo/, RUNS the number of runs behind each median (default: 5; the first
# one, which describes the objects, does not count). THREADS in the environment sets --threads (default: 2), WORK the
# folder of the simulated frame (default: out/regions; its caches are kept). The boxes are the ground truth's visible
# ones of the image's objects; past their number they are repeated, so that each object is searched several times.
# Compare two programs in turns on an idle machine: one run each, several times over.
set -euo pipefail
[ $# -eq 2 ] || [ $# -eq 3 ] || { sed -n '2,12s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; exit 2; }
program=$(realpath "$1") data=$(realpath "$2") runs=${3:-5} threads=${THREADS:-2}
cd "$(dirname "${BASH_SOURCE[0]}")/.."
work=${WORK:-out/regions}
mkdir -p "$work"
work=$(realpath "$work")
export XDG_CACHE_HOME=$work/cache
image=607
if [ ! -d "$work/sim" ]; then
    "$program" simulate-depth --dataset "$data/lmo" --images $image --out "$work/sim.new" >/dev/null
    mv "$work/sim.new" "$work/sim"
fi

# The targets file and the COCO file of so many regions.
regions() {
    python3 - "$work" $image "$1" <<'PY'
import json
import sys

work, image, wanted = sys.argv[1], sys.argv[2], int(sys.argv[3])
folder = f"{work}/sim/test/000002"
with open(f"{folder}/scene_gt.json") as truth, open(f"{folder}/scene_gt_info.json") as info:
    objects = zip(json.load(truth)[image], json.load(info)[image])
boxes = [(t["obj_id"], i["bbox_visib"]) for t, i in objects if i["visib_fract"] > 0.1]
regions = [boxes[k % len(boxes)] for k in range(wanted)]
common = {"scene_id": 2}
found = [
    {**common, "image_id": int(image), "category_id": id, "bbox": box, "score": 1.0, "time": -1.0} for id, box in regions
]
ids = sorted({id for id, _ in regions})
counts = [sum(id == other for other, _ in regions) for id in ids]
targets = [{**common, "im_id": int(image), "obj_id": id, "inst_count": count} for id, count in zip(ids, counts)]
for name, content in (("boxes", found), ("targets", targets)):
    with open(f"{work}/{name}-{wanted}.json", "w") as file:
        json.dump(content, file)
PY
}

printf '| method | regions | whole run (ms) | the image alone (ms) |\n|---|---|---|---|\n'
for method in ppf mttm; do
    for number in 1 8 30; do
        regions $number
        : >"$work/times"
        for run in $(seq 0 "$runs"); do
            rm -f "$work/poses.csv" "$work/poses.csv.run.json"
            began=$(date +%s%N)
            status=0
            "$program" --threads "$threads" estimate --method $method --dataset "$work/sim" --targets "$work/targets-$number.json" \
                --boxes "$work/boxes-$number.json" --min-score 0 --out "$work/poses.csv" --json "$work/poses.json" >"$work/log" 2>&1 || status=$?
            ended=$(date +%s%N)
            [ $status -le 1 ] || { cat "$work/log" >&2; exit 1; }
            [ "$run" -eq 0 ] || echo $((ended - began)) "$(python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))["seconds_per_image"])' "$work/poses.json")" >>"$work/times"
        done
        python3 - "$work/times" $method $number <<'PY'
import statistics
import sys

path, method, number = sys.argv[1:]
with open(path) as file:
    rows = [line.split() for line in file]
whole = statistics.median(int(row[0]) / 1e6 for row in rows)
image = statistics.median(1000 * float(row[1]) for row in rows)
print(f"| {method} | {number} | {whole:.0f} | {image:.0f} |", flush=True)
PY
    done
done
