"""What another calibration makes of poses that were already found.

    sixfold reproduce auto --dataset DIR/lmo --every 2 --given color --out OUT
    python benches/rescore_probabilities.py OUT crates/sixfold-auto/calibration.json

The rows that `sixfold reproduce auto` keeps contain the numbers from which probabilities are computed, so that a calibration can be measured
without searching again; that poses at one place share their probability is left out. Prints how many of the most probable poses are right, how
many are reported (0.5 and more) and right, the expected calibration error (Naeini et al. 2015, ten bins), and what it would be for exact
probabilities (Bröcker and Smith 2007). Needs numpy."""

import json
import sys
from pathlib import Path

import numpy as np

DRAWS = 1000


def log_odds(model, numbers):
    known = [0.0 if numbers[k] is None else (numbers[k] - mean) / deviation
             for k, mean, deviation in zip(model["takes"], model["means"], model["deviations"])]
    raw = np.dot(model["weights"], known) + model["constant"]
    return model["scaling"][0] * raw + model["scaling"][1]


def model_for(calibration, given, numbers):
    searched = all(numbers[calibration["names"].index(name)] is not None for name in ("recognised", "support"))
    return calibration["color_without_search" if given == "color" and not searched else given]


def error(probabilities, right):
    bins = np.minimum((probabilities * 10).astype(int), 9)
    off = [abs((probabilities - right)[bins == b].sum()) for b in range(10)]
    return sum(off) / max(len(right), 1)


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    folder, calibration = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
    searches = [s for path in sorted((folder / "rows").glob("*.json")) for s in json.loads(path.read_text())]
    if not searches:
        sys.exit(f"{folder}/rows: no rows of `sixfold reproduce auto`")
    for given in ("depth", "color", "both"):
        poses = [s["poses"] for s in searches if s["given"] == given and s["poses"]]
        if not poses:
            continue
        odds = [[log_odds(model_for(calibration, given, p["numbers"]), p["numbers"]) for p in of] for of in poses]
        best = [max(zip(odds_of, (p["right"] for p in of))) for odds_of, of in zip(odds, poses)]
        probabilities = 1 / (1 + np.exp([-z for z, _ in best]))
        right = np.array([r for _, r in best])
        random = np.random.default_rng(0)
        chance = np.mean([error(probabilities, random.random(len(right)) < probabilities) for _ in range(DRAWS)])
        reported = probabilities >= 0.5
        print(f"{given}: {len(right)} poses, {right.sum()} right, {reported.sum()} reported, {(reported & right).sum()} of these right, "
              f"error {error(probabilities, right):.3f} (exact probabilities {chance:.3f}), "
              f"most probable wrong pose {max(probabilities[~right], default=0):.2f}")


if __name__ == "__main__":
    main()
