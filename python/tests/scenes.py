"""Shapes and detections that tests and comparisons are made of; only numpy is needed."""

import numpy as np

import sixfold


def posed(translation, turn):
    """A pose from a translation in metres and a rotation vector in radians."""
    pose = sixfold.pose_exp([0, 0, 0, *turn])
    pose[:3, 3] = translation
    return pose


def box_mesh(size=(0.1, 0.06, 0.04), **kwargs):
    """A box around the origin, its faces looking outwards."""
    corners = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)]) * size
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    faces = [triangle for a, b, c, d in quads for triangle in ([a, b, c], [a, c, d])]
    return sixfold.Mesh(corners, faces, **kwargs)


def bumpy_mesh(rings=40, sectors=80):
    """A closed surface without symmetry, about 12 cm wide."""
    theta = np.linspace(0.02, np.pi - 0.02, rings)
    phi = np.linspace(0, 2 * np.pi, sectors, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    radius = 1 + 0.2 * np.sin(2 * p + 0.5) * np.sin(t) ** 2 + 0.15 * np.cos(3 * t) + 0.1 * np.sin(p) * np.sin(2 * t)
    points = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1) * radius[..., None]
    points = points.reshape(-1, 3) * [0.06, 0.045, 0.05]
    faces = []
    for i in range(rings - 1):
        for j in range(sectors):
            a, b = i * sectors + j, i * sectors + (j + 1) % sectors
            c, d = a + sectors, b + sectors
            faces += [[a, c, d], [a, d, b]]
    for start, flip in ((0, False), ((rings - 1) * sectors, True)):
        for j in range(1, sectors - 1):
            triangle = [start, start + j, start + j + 1]
            faces.append(triangle[::-1] if flip else triangle)
    return sixfold.Mesh(points, faces)


def scenario(rng, images=20, with_masks=False):
    truth = {"images": [], "annotations": [], "categories": [{"id": i, "name": str(i)} for i in (1, 2, 3)]}
    found = []
    for image_id in range(1, images + 1):
        truth["images"].append({"id": image_id, "width": 320, "height": 240})
        for _ in range(rng.integers(0, 5)):
            x, y = rng.uniform(0, [220, 140])
            w, h = rng.uniform(8, 100, 2)
            category = int(rng.integers(1, 4))
            entry = {
                "id": len(truth["annotations"]) + 1,
                "image_id": image_id,
                "category_id": category,
                "bbox": [x, y, w, h],
                "area": w * h,
                "iscrowd": int(rng.random() < 0.05),
            }
            truth["annotations"].append(entry)
            for _ in range(rng.integers(0, 3)):
                moved = np.array([x, y, w, h]) * rng.normal(1, 0.08, 4)
                found.append(
                    {
                        "image_id": image_id,
                        "category_id": category if rng.random() < 0.9 else 1,
                        "score": float(np.round(rng.random(), 2)),
                        "bbox": np.maximum(moved, 1).tolist(),
                    }
                )
    return truth, found
