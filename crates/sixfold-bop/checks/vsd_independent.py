"""VSD written down again from its definition (Hodan, Michel et al. 2018, with BOP'19 visibility), numpy only.

    cargo run -p sixfold-bop --example vsd_cases -- FOLDER
    python vsd_independent.py FOLDER

Reads the depth images and errors that the example wrote and says how far the two are apart.
"""

import json
import pathlib
import sys

import numpy as np


def distances(depth, c):
    """Depth along the axis to distance along the ray."""
    v, u = np.indices(depth.shape)
    ray = np.stack([(u - c["cx"]) / c["fx"], (v - c["cy"]) / c["fy"], np.ones(depth.shape)])
    return depth.astype(np.float64) * np.linalg.norm(ray, axis=0)


def vsd(estimate, truth, test, c):
    has_e, has_g, has_t = estimate > 0, truth > 0, test > 0
    d_e, d_g, d_t = (distances(z, c) for z in (estimate, truth, test))
    seen_g = has_g & (~has_t | (d_g <= d_t + c["delta"]))
    seen_e = has_e & (~has_t | (d_e <= d_t + c["delta"]) | seen_g)
    union, both = seen_g | seen_e, seen_g & seen_e
    errors = []
    for tau in c["taus"]:
        cost = np.where(both, np.abs(d_e - d_g) / c["diameter"] >= tau, True)
        errors.append(float(cost[union].mean()) if union.any() else 1.0)
    return errors


def main():
    folder = pathlib.Path(sys.argv[1])
    worst, values = 0.0, []
    for c in json.loads((folder / "cases.json").read_text()):
        shape = (c["height"], c["width"])
        read = lambda name: np.fromfile(folder / f"{c['case']}_{name}.f32", "<f4").reshape(shape)  # noqa: E731
        expected = vsd(read("estimate"), read("truth"), read("test"), c)
        worst = max(worst, float(np.max(np.abs(np.subtract(expected, c["errors"])))))
        values += expected
    print(f"{len(values)} values from {min(values):.3f} to {max(values):.3f}, largest difference {worst:.1e}")
    sys.exit(worst > 1e-9)


main()
