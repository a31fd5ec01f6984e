#!/usr/bin/env python3
"""Writes every table of measured numbers in the texts from the files in results/.

    python3 docs/tools/tables.py            write the tables
    python3 docs/tools/tables.py --check    exit status 1, naming file and table, where a text and the files differ

A table stands in a text between `<!-- table: NAME -->` and `<!-- /table -->`; what is between them is replaced. The tables are
listed below in TABLES. A value comes from `results/NAME.json`, which `benches/results.sh` writes, or from
`results/by-hand/NAME.json`, a table that was measured by hand (`head`, `rows`, the command, and the commit that wrote the numbers
down). Under each table stand its files with commit, machine where it matters, and command.
"""

import json
import re
import sys
from decimal import Decimal
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
BY_HAND = RESULTS / "by-hand"
MARK = re.compile(r"(?m)^([ ]*)<!-- table: (\S+) -->\n(.*?)^[ ]*<!-- /table -->$", re.DOTALL)


class Literal(str):
    """A number as it stands in a file by hand: 0.590 stays 0.590."""


def load(name):
    """A file of results, by name. Numbers of files by hand keep their digits."""
    path = RESULTS / f"{name}.json"
    if path.exists() and by_hand(name):
        raise SystemExit(f"tables.py: results/{name}.json and results/by-hand/{name}.json have one name: remove one of them")
    if path.exists():
        return json.loads(path.read_text())
    path = BY_HAND / f"{name}.json"
    if path.exists():
        return json.loads(path.read_text(), parse_float=Literal)
    raise SystemExit(f"tables.py: neither results/{name}.json nor results/by-hand/{name}.json is there")


def value(file, path):
    """A value of a file of results: keys with dots between, numbers for places in lists."""
    found = load(file)["values"]
    for key in path.split("."):
        try:
            found = found[int(key)] if isinstance(found, list) else found[key]
        except (KeyError, IndexError, ValueError):
            raise SystemExit(f"tables.py: results/{file}.json has no {path} ({key} is missing)") from None
    return found


def text(cell, digits=3):
    """A cell as it is printed: fractions with three digits, nothing as a dash."""
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return str(round(Decimal(repr(cell)), digits))
    return str(cell).replace("|", "\\|")


def is_number(cell):
    return cell is None or isinstance(cell, (int, float, Literal))


def layout(head, rows):
    """A table in Markdown; columns of numbers are aligned to the right, those in mm, degrees or dB have one digit after the point."""
    digits = [1 if head_cell.endswith(("(mm)", "(degrees)", "(dB)")) else 3 for head_cell in head]
    right = [bool(rows) and all(is_number(row[i]) for row in rows) for i in range(len(head))]
    lines = [head, ["---:" if r else "---" for r in right], *([text(cell, d) for cell, d in zip(row, digits)] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def by_hand(name):
    return (BY_HAND / f"{name}.json").exists()


def command_of(name):
    """The command of a file, a line for each of its parts."""
    return [part.strip() for part in re.split(r"&&|; ", re.sub(r"  +", " ", load(name)["command"]))]


def source(name):
    """What stands under a table: file, commit, machine, command."""
    file = load(name)
    machine = f", {file['machine']}" if file.get("machine") else ""
    if by_hand(name):
        how = f"<code>results/by-hand/{name}.json</code>, measured by hand, written down at commit {file['commit']}{machine}"
    else:
        how = f"<code>results/{name}.json</code>, commit {file['commit']}, seed {file['seed']}{machine}"
    lines = "\n".join(command_of(name))
    return f"<details><summary>{how}</summary>\n\n```sh\n{lines}\n```\n\n</details>\n"


# ---- what each table holds -----------------------------------------------------------------------------------------


def scores(rows, first, fields):
    """A row for each (title, file, path to the scores): the chosen fields of `sixfold eval`."""
    heads = {"targets": "targets", "ar": "AR", "ar_vsd": "AR_VSD", "ar_mssd": "AR_MSSD", "ar_mspd": "AR_MSPD",
             "add_s_recall.mean": "ADD(-S) recall"}
    body = [[*titles, *(value(file, f"{path}.{field}") for field in fields)] for titles, file, path in rows]
    return [*first, *(heads[field] for field in fields)], body, list(dict.fromkeys(file for _, file, _ in rows))


def depth():
    rows = [
        (["point pair features", sensor, where], f"ppf_{sensor}", path)
        for sensor in ("kinect", "xtion")
        for where, path in (("whole image", "scores"), ("ground-truth boxes", "scores_in_boxes"))
    ] + [
        (["templates", sensor, where], f"mttm_{sensor}", path)
        for sensor in ("kinect", "xtion")
        for where, path in (("whole image", "scores"), ("ground-truth boxes", "scores_in_boxes"))
    ] + [
        (["all methods (auto), with colour", "kinect", "whole image"], "auto", "scores_kinect")
    ] + [(["templates, points alone", sensor, "whole image"], f"mttm_{sensor}", "scores_by_points") for sensor in ("kinect", "xtion")]
    return scores(rows, ["method", "simulated sensor", "searched in"],
                  ["targets", "ar", "ar_vsd", "ar_mssd", "ar_mspd", "add_s_recall.mean"])


def demo():
    def right(poses, image):
        own = [pose for pose in poses if pose["image"] == image]
        return len(own), sum(pose["add_s_of_diameter"] is not None and pose["add_s_of_diameter"] < 0.1 for pose in own)

    depth, colour = value("demo", "demo.poses"), value("demo", "demo.colour.poses")
    body = []
    for image, kind in dict.fromkeys((pose["image"], pose["depth"]) for pose in depth):
        targets, found = right(depth, image)
        body.append([image, "measured" if kind == "real" else kind, targets, found, right(colour, image)[1]])
    return ["image", "depth", "objects", "right from depth", "right from the colour image alone"], body, ["demo"]


def templates():
    body = [[row["title"].replace("printed score", "published score"), row["all"]["targets"], row["all"]["iou"], row["all"]["add_s"]]
            for row in value("mttm_rows", "rows.rows")]
    return ["what", "targets", "masks with IoU above 0.5", "ADD(-S) recall"], body, ["mttm_rows"]


def piles():
    return scores([(["point pair features"], "clutter", "scores_ppf"), (["templates seen from above"], "clutter", "scores_above"),
                   (["templates seen from around"], "clutter", "scores_around")], ["method"],
                  ["targets", "ar_mssd", "ar_mspd", "add_s_recall.mean"])


def colour():
    return scores([(["Pix2Pose", "ground truth"], "pix2pose", "scores"),
                   (["Pix2Pose", "our detector's"], "pix2pose", "scores_in_detected_boxes"),
                   (["views, no training for the object", "ground truth"], "views", "scores"),
                   (["MegaPose, published estimates", "its own detections"], "evaluator", "megapose")],
                  ["method", "boxes"], ["targets", "ar_mssd", "ar_mspd", "add_s_recall.mean"])


def pix2pose_icp():
    rows = [([how, what], "pix2pose_icp", f"scores_{key}") for how, name in (("--preset published", "published"), ("ours", "ours"))
            for what, key in (("colour", name), ("colour, then ICP", f"{name}_icp"))]
    return scores(rows, ["Pix2Pose", "input"], ["targets", "ar", "ar_vsd", "ar_mssd", "ar_mspd", "add_s_recall.mean"])


def evaluator():
    expected = {"AR_MSSD": "ar_mssd", "AR_MSPD": "ar_mspd", "ADD(-S) recall": "add_s_recall.mean"}
    return ["score of MegaPose's published estimates", "Sixfold"], \
        [[name, value("evaluator", f"megapose.{path}")] for name, path in expected.items()], ["evaluator"]


def detection():
    body = [[kind, value("detector", "scores.images"), *(value("detector", f"scores.{kind}.{key}") for key in ("ap", "ap50", "ap75", "ar100"))]
            for kind in ("box", "mask")]
    return ["what", "images", "AP", "AP50", "AP75", "AR100"], body, ["detector"]


def detection_views():
    ways = [("boxes of poses", "views", "box"), ("masks of poses", "views", "mask"), ("proposals, named (`--quick`)", "quick", "box"),
            ("their masks", "quick", "mask")]
    body = [[name, value("detector_views", f"{way}.images"), *(value("detector_views", f"{way}.{kind}.{key}") for key in ("ap", "ap50", "ap75", "ar100"))]
            for name, way, kind in ways]
    return ["what", "images", "AP", "AP50", "AP75", "AR100"], body, ["detector_views"]


def probability():
    body = []
    for images, path in (("simulated scenes", "simulated.rows"), ("three sample images", "samples.rows")):
        for row in value("auto", path):
            given = {"both": "depth and colour"}.get(row["given"], row["given"])
            body.append([images, given, row["present"], row["found"], row["kept"], row["precision"], row["absent"],
                         row["accepted"] if row["absent"] else None, row["at_once"]["accepted"] if row["absent"] else None,
                         row["at_once"]["kept"], row["at_once"]["precision"], row["expected_error"], row["error_by_chance"]])
    return ["images", "given", "objects present", "best pose right", "right poses reported", "right among the reported",
            "objects absent", "absent objects reported", "absent objects reported, all searched at once", "right poses reported, all at once",
            "right among the reported, all at once", "expected calibration error", "the same for exact probabilities"], body, ["auto"]


def new_poses():
    titles = {"printed rule, the network's rendering": "published rule, the network's rendering",
              "printed rule, mean of the colours": "published rule, mean of the colours"}
    body = []
    for photographs, path in (("real", "reproduced.poses"), ("rendered, exact poses", "reproduced.drawn_poses")):
        for row in value("nol", path):
            title = titles.get(row["title"], row["title"]).replace("begun at", "started at")
            every = row["all"]
            body.append([photographs, title, every["sources"], every["millimetres"], every["millimetres_across"], every["degrees"]])
    return ["photographs", "poses", "instances", "position error, median (mm)", "across the optical axis (mm)",
            "rotation error, median (degrees)"], body, ["nol"]


def new_views():
    kinds = {"best": "plain texturing", "average": "averaging", "network": "network"}
    body = []
    for row in value("nol", "reproduced.views"):
        what = f"vertex-coloured model, {row['method']}" if row["set"] == "model" else kinds.get(row["method"], row["method"])
        poses = None if row["set"] == "model" else row["set"]
        plain, placed = row["plain"], row["placed"]
        body.append([what, poses, row["targets"], plain["psnr"], plain["ssim"], plain["perceptual"], placed["perceptual"]])
    return ["view", "sources", "targets", "PSNR (dB)", "SSIM", "perceptual distance", "perceptual distance after light and shift"], \
        body, ["nol"]


def grasps():
    body = [[row["class"], row["trials"], row["successes"], row["rate"], *row["interval"]] for row in value("grasp", "measured.classes")]
    return ["class", "trials", "held", "success rate", "95 % from", "95 % to"], body, ["grasp"]


def times():
    """The files of times by hand in one table, each row with its commit."""
    files = ["times_ppf", "times_mttm", "times_pix2pose", "times_views", "times_detector", "times_proposals", "times_grasps",
             "times_views_new", "times_sensor", "times_retrieval"]
    body = [[*row, load(file)["commit"]] for file in files for row in load(file)["rows"]]
    return ["what", "per", "time (ms)", "commit"], body, files


def headline():
    """The README's table. One row a task."""

    def time(file, row=0):
        return round(float(load(file)["rows"][row][2]) / 1000, 3)

    classes = value("grasp", "measured.classes")
    rows = [
        ("poses from depth and colour, no training", "recall, ADD(-S)", value("auto", "scores_kinect.add_s_recall.mean"), None,
         "sixfold estimate"),
        ("poses from depth, no training", "recall, ADD(-S)", value("ppf_kinect", "scores.add_s_recall.mean"), time("times_ppf"),
         "sixfold estimate --method ppf"),
        ("poses from colour, trained on 16 images", "recall, ADD(-S)", value("pix2pose", "scores.add_s_recall.mean"), time("times_pix2pose"),
         "sixfold estimate --method pix2pose"),
        ("poses from colour, no training", "recall, ADD(-S)", value("views", "scores.add_s_recall.mean"), time("times_views"),
         "sixfold estimate --method views"),
        ("MegaPose, published estimates", "recall, ADD(-S)", value("evaluator", "megapose.add_s_recall.mean"), None, "sixfold eval"),
        ("boxes from colour, trained", "AP50", value("detector", "scores.box.ap50"), time("times_detector"), "sixfold detect"),
        ("boxes from colour, no training", "AP50", value("detector_views", "views.box.ap50"), None, "sixfold detect --method views"),
        ("absent objects that are reported", "fraction", value("auto", "simulated.rows.0.accepted"), None, "sixfold estimate"),
        ("the same, all objects searched at once", "fraction", value("auto", "simulated.rows.0.at_once.accepted"), None, "sixfold estimate"),
        ("grasps from depth, in simulation", "held", next(row["rate"] for row in classes if row["class"] == "all"), time("times_grasps"),
         "sixfold grasp propose"),
    ]
    files = ["ppf_kinect", "pix2pose", "views", "evaluator", "detector", "detector_views", "auto", "grasp"]
    return ["what", "measure", "value", "time (s)", "command"], [[*row[:4], f"`{row[4]}`"] for row in rows], files


def hundredths(number):
    return Literal(f"{number:.2f}")


def teach():
    taught = value("teach", "taught")
    symmetries = ("symmetries", "symmetries_true")
    found = ("found", "found_with_true_mesh", "found_auto", "found_auto_with_true_mesh", "wrong_auto")
    body = [[row["name"].replace("_", " "), row["diameter_mm"], hundredths(row["camera_mm"]), Literal(f"{row['camera_deg']:.3f}"),
             row["mask_iou"], hundredths(row["mesh_mm"]), hundredths(row["truth_mm"]), *(sum(row[key]) for key in symmetries),
             *(row[key] for key in found)]
            for row in taught["objects"]]
    body.append(["all", None, hundredths(taught["camera_mm_median"]), Literal(f"{taught['camera_deg_median']:.3f}"), None,
                 hundredths(taught["mesh_mm_mean"]), hundredths(taught["truth_mm_mean"]), None, None, *(taught[key] for key in found)])
    return ["object", "diameter (mm)", "camera (mm)", "camera (degrees)", "mask IoU", "mesh to truth (mm)", "truth to mesh (mm)",
            "symmetries", "of the true mesh", "depth: found of 5", "with the true mesh", "auto: found of 5", "with the true mesh",
            "reported, wrong"], body, ["teach"]


def teach_depth():
    ways = [value("teach", "taught"), value("teach_depth", "with_depth"), value("teach_depth", "one_view")]

    def cells(name, of):
        found = [of(way) for way in ways]
        return [name, *(hundredths(row["mesh_mm"]) for row in found), *(row["found_auto"] for row in found),
                found[0]["found_auto_with_true_mesh"]]

    body = [cells(row["name"].replace("_", " "), lambda way, i=i: way["objects"][i]) for i, row in enumerate(ways[0]["objects"])]
    body.append(cells("all", lambda way: {**way, "mesh_mm": way["mesh_mm_mean"]}))
    return ["object", "mesh to truth (mm): photographs", "with depth", "one view", "found of 5: photographs", "with depth", "one view",
            "the true mesh"], body, ["teach", "teach_depth"]


def ours(path):
    """A measured value of docs/published.json: FILE:KEYS of a file of results, or FILE[ROW][COLUMN] of one by hand."""
    if path is None:
        return None
    if cell := re.fullmatch(r"(\w+)\[(\d+)\]\[(\d+)\]", path):
        name, row, column = cell.groups()
        rows = load(name)["rows"]
        if int(row) >= len(rows) or int(column) >= len(rows[int(row)]):
            raise SystemExit(f"tables.py: {name} has no {path}")
        return rows[int(row)][int(column)]
    name, _, keys = path.partition(":")
    return value(name, keys)


def chapter(number):
    """A chapter's published numbers beside ours, from docs/published.json."""
    body = [[table, what, published, ours(path), where] for table, what, published, path, where in published_rows()[number]["rows"]]
    return ["table", "quantity", "published", "ours", "ours measured on"], body, []


def published_rows():
    return json.loads((ROOT / "docs/published.json").read_text(), parse_float=Literal)


def published_commands(number):
    """The commands of a chapter's tables."""
    parts = [f"# {table}\n" + "\n".join(lines) for table, *lines in published_rows()[number]["commands"]]
    body = "\n".join(parts)
    return f"<details><summary>Commands, chapter {number}</summary>\n\n```sh\n{body}\n```\n\n</details>\n"


def chapter_3():
    return chapter("3")


def chapter_4():
    return chapter("4")


def chapter_5():
    return chapter("5")


def chapter_6():
    return chapter("6")


CHAPTERS = {"chapter_3": "3", "chapter_4": "4", "chapter_5": "5", "chapter_6": "6"}
TABLES = {table.__name__: table for table in
          (chapter_3, chapter_4, chapter_5, chapter_6, pix2pose_icp, depth, demo, templates, piles, colour, evaluator, detection, detection_views, probability, new_poses, new_views, grasps, teach, teach_depth, times, headline)}


def rendered(name):
    """The text of a table with its sources."""
    if name in TABLES:
        head, rows, files = TABLES[name]()
    elif by_hand(name):
        file = load(name)
        head, rows, files = file["head"], file["rows"], [name]
    else:
        raise SystemExit(f"tables.py: found table {name}, expected one of {', '.join([*TABLES, *sorted(p.stem for p in BY_HAND.glob('*.json'))])}")
    body = layout(head, rows)
    if name == "headline":
        commits = {}
        for file in files:
            commits.setdefault(load(file)["commit"], []).append(f"`{file}`")
        from_files = "; ".join(f"{', '.join(names)} at commit {commit}" for commit, names in commits.items())
        return f"{body}\nValues from `results/*.json`: {from_files}.\n"
    if name in CHAPTERS:
        return f"{body}\n{published_commands(CHAPTERS[name])}"
    return f"{body}\n{''.join(source(file) for file in files)}"


def texts():
    """The texts that have tables: those beside the README, and the book."""
    return [ROOT / "README.md", ROOT / "ARCHITECTURE.md", ROOT / "python/README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def filled(path):
    """A text with its tables as the files have them, and the names of those that differ."""
    old, differing = path.read_text(), []

    def put(match):
        indent, name, before = match.groups()
        new = "".join(indent + line if line.strip() else line for line in rendered(name).splitlines(keepends=True))
        if new != before:
            differing.append(name)
        return f"{indent}<!-- table: {name} -->\n{new}{indent}<!-- /table -->"

    new = MARK.sub(put, old)
    for kind in ("<!-- table:", "<!-- /table -->"):
        if old.count(kind) != len(MARK.findall(old)):
            raise SystemExit(f"tables.py: {path.relative_to(ROOT)}: a mark of a table has no partner")
    return new, differing, len(MARK.findall(old))


def main():
    if sys.argv[1:] not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    check, count, wrong = bool(sys.argv[1:]), 0, 0
    for path in texts():
        new, differing, tables = filled(path)
        count += tables
        for name in differing:
            wrong += 1
            print(f"{path.relative_to(ROOT)}: table {name} {'differs from the results: run docs/tools/tables.py' if check else 'written'}")
        if differing and not check:
            path.write_text(new)
    print(f"{count} tables, {wrong} {'differ' if check else 'written'}")
    return int(check and wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
