"""Repeats the trials of `sixfold grasp measure` in MuJoCo: same objects, poses, gripper, path and forces, another engine.

    python3 -m venv .venv && .venv/bin/pip install mujoco==4.0.0
    sixfold grasp measure --list benches/grasp-objects.json --meshes DIR --out out/grasps
    .venv/bin/python benches/grasps_vs_mujoco.py out/grasps/trials.json [--each N] [--json FILE]

Prints how often both engines agree on "held", per class, and every trial on which they differ. Exit status 0 when they
agree on at least 85 % of the trials, 1 otherwise, 2 for a file that is none. What differs by design: contacts are soft here
and stiff in Rapier, and the jaws are coupled by a constraint here and by a spring there.
"""

import argparse
import json
import sys

import mujoco
import numpy as np

FINGER_MASS = 0.3
CLOSING_SPEED = 0.1
SQUEEZE = 0.3
MIN_GAP = 0.0005


def quaternion(rotation):
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(rotation).ravel())
    return out


def text(values):
    return " ".join(f"{v:.9g}" for v in np.ravel(values))


def boxes(gripper, opening):
    """Centre and half size of the first finger, the second finger and the palm, in the gripper's frame."""
    length, thickness = gripper["finger_length"], gripper["finger_thickness"]
    half = [thickness / 2, gripper["finger_width"] / 2, length / 2]
    x = opening / 2 + thickness / 2
    height = gripper["palm_height"]
    palm = [gripper["palm_width"] / 2, gripper["palm_depth"] / 2, height / 2]
    return [
        ([-x, 0, -length / 2], half),
        ([x, 0, -length / 2], half),
        ([0, 0, -length - height / 2], palm),
    ]


def model_of(parts, gripper, options, world_from_object, palm_at, rotation, opening):
    """The scene as MJCF. The palm slides along the world's axes; its target is set at every step."""
    assets = "".join(f'<mesh name="p{i}" vertex="{text(p)}"/>' for i, p in enumerate(parts))
    # A pair's friction is the larger of both: the object's is 0.
    geoms = "".join(
        f'<geom type="mesh" mesh="p{i}" contype="1" conaffinity="6" friction="0 0 0" density="1000"/>'
        for i in range(len(parts))
    )
    pad = f'contype="2" conaffinity="1" friction="{gripper["friction"]} 0 0"'
    (left, half), (right, _), (palm, palm_half) = boxes(gripper, opening)
    spare = (gripper["max_opening"] - opening) / 2
    fingers = "".join(
        f'<body name="f{i}" pos="{text(at)}" gravcomp="1">'
        f'<joint name="f{i}" type="slide" axis="{axis} 0 0" limited="true" range="{-spare - 1e-6} {opening / 2}"/>'
        f'<geom name="f{i}" type="box" size="{text(half)}" mass="{FINGER_MASS}" {pad}/></body>'
        for i, (at, axis) in enumerate([(left, 1), (right, -1)])
    )
    # Slides are along the palm's own axes, which do not turn.
    slides = "".join(
        f'<joint name="s{k}" type="slide" axis="{text(np.eye(3)[k])}"/>' for k in range(3)
    )
    drives = "".join(f'<position name="s{k}" joint="s{k}" kp="200000" kv="4000"/>' for k in range(3))
    start = world_from_object[:3, 3]
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{options["time_step"]}" cone="elliptic" impratio="10" integrator="implicitfast" gravity="0 0 -9.81">
    <flag multiccd="enable"/>
  </option>
  <default><geom condim="3" solref="0.004 1" solimp="0.95 0.99 0.0005" margin="0"/></default>
  <asset>{assets}</asset>
  <worldbody>
    <geom type="plane" size="2 2 0.1" contype="4" conaffinity="1" friction="{options["table_friction"]} 0 0"/>
    <body name="object" pos="{text(start)}" quat="{text(quaternion(world_from_object[:3, :3]))}">
      <freejoint/>{geoms}
    </body>
    <body name="palm" pos="{text(palm_at)}" quat="{text(quaternion(rotation))}" gravcomp="1">
      {slides}<geom type="box" pos="{text(palm)}" size="{text(palm_half)}" mass="5" {pad}/>{fingers}
    </body>
  </worldbody>
  <equality><joint joint1="f0" joint2="f1" polycoef="0 1 0 0 0" solref="0.004 1"/></equality>
  <actuator>{drives}<motor name="f0" joint="f0"/><motor name="f1" joint="f1"/></actuator>
</mujoco>"""


class Run:
    def __init__(self, parts, gripper, options, trial):
        self.gripper, self.options = gripper, options
        self.opening = trial["opening"]
        world_from_object = np.array(trial["world_from_object"])
        world_from_gripper = np.array(trial["world_from_gripper"])
        self.rotation = world_from_gripper[:3, :3]
        self.approach = self.rotation[:, 2]
        self.palm_start = world_from_gripper[:3, 3] - self.approach * options["stand_off"]
        xml = model_of(
            parts, gripper, options, world_from_object, self.palm_start, self.rotation, self.opening
        )
        self.model = mujoco.MjModel.from_xml_string(xml)
        body = self.model.body("object").id
        scale = options["mass"] / self.model.body_mass[body]
        self.model.body_mass[body] *= scale
        self.model.body_inertia[body] *= scale
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.target = np.zeros(3)
        self.closing = False
        self.start_height = world_from_object[2, 3]

    def finger(self, i):
        joint = self.model.joint(f"f{i}")
        return self.data.qpos[joint.qposadr[0]], self.data.qvel[joint.dofadr[0]]

    def gap(self):
        return self.opening - self.finger(0)[0] - self.finger(1)[0]

    def step(self):
        # The palm's slides are in its own axes.
        self.data.ctrl[:3] = self.rotation.T @ self.target
        limit = self.gripper["force"]
        for i in range(2):
            position, speed = self.finger(i)
            if self.closing:
                force = 1e3 * (CLOSING_SPEED - speed)
            else:
                force = -1e4 * position - 1e2 * speed
            self.data.ctrl[3 + i] = np.clip(force, -limit, limit)
        mujoco.mj_step(self.model, self.data)

    def steps(self, seconds):
        return int(np.ceil(seconds / self.options["time_step"] - 1e-9))

    def wait(self, seconds):
        for _ in range(self.steps(seconds)):
            self.step()

    def travel(self, way):
        length = np.linalg.norm(way)
        if length < 1e-9:
            return
        start, count = self.target.copy(), max(self.steps(1.5 * length / self.options["speed"]), 1)
        for k in range(1, count + 1):
            s = k / count
            self.target = start + way * (s * s * (3 - 2 * s))
            self.step()

    def shake(self, amplitude, seconds=1.0):
        start, count = self.target.copy(), self.steps(seconds)
        for k in range(1, count + 1):
            t = k / count
            envelope = min(8 * t, 8 * (1 - t), 1)
            swing = envelope * np.sin(2 * np.pi * self.options["shake_frequency"] * seconds * t)
            self.target = start + amplitude * swing
            self.step()

    def touches(self):
        fingers = [self.model.geom(f"f{i}").id for i in range(2)]
        touched = {int(g) for c in self.data.contact[: self.data.ncon] for g in (c.geom1, c.geom2)}
        return all(f in touched for f in fingers)

    def holds(self):
        raised = self.data.body("object").xpos[2] - self.start_height
        return self.gap() > MIN_GAP and self.touches() and raised > 0.5 * self.options["lift"]

    def outcome(self):
        self.travel(self.approach * self.options["stand_off"])
        self.closing = True
        self.wait(0.5 * self.opening / CLOSING_SPEED + SQUEEZE)
        if self.gap() < MIN_GAP or not self.touches():
            return "missed"
        self.travel(np.array([0, 0, self.options["lift"]]))
        self.wait(0.2)
        if not self.holds():
            return "lost_in_lift"
        side = self.rotation[:, 0] * [1, 1, 0]
        side = side / np.linalg.norm(side) if np.linalg.norm(side) > 0.1 else np.array([1.0, 0, 0])
        for direction in (np.array([0, 0, 1.0]), side):
            self.shake(direction * self.options["shake"])
        self.wait(0.2)
        return "held" if self.holds() else "lost_in_shake"


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("trials")
    arguments.add_argument("--each", type=int, default=0, help="at most this many trials of each object")
    arguments.add_argument("--json", help="write all outcomes to this file")
    a = arguments.parse_args()
    try:
        with open(a.trials) as f:
            whole = json.load(f)
        gripper, options, objects = whole["gripper"], whole["trial"], whole["objects"]
    except (OSError, ValueError, KeyError) as error:
        print(f"{a.trials}: {error!r}, expected the trials.json of `sixfold grasp measure --out`", file=sys.stderr)
        return 2
    rows, counts = [], {}
    for item in objects:
        tried = [t for t in item["trials"] if t["report"] and t["report"]["outcome"] != "blocked"]
        for trial in tried[: a.each or None]:
            ours = trial["report"]["outcome"]
            theirs = Run(item["parts"], gripper, options, trial).outcome()
            rows.append({"object": item["name"], "number": trial["number"], "rapier": ours, "mujoco": theirs})
            count = counts.setdefault(item["class"], [0, 0, 0, 0])
            count[0] += 1
            count[1] += ours == "held"
            count[2] += theirs == "held"
            count[3] += (ours == "held") == (theirs == "held")
            if (ours == "held") != (theirs == "held"):
                print(f"differs: {item['name']} {trial['number']}: rapier {ours}, mujoco {theirs}")
    if not rows:
        print(f"{a.trials}: no trial to repeat", file=sys.stderr)
        return 2
    counts["all"] = [sum(c[k] for c in counts.values()) for k in range(4)]
    print(f"{'class':<12} {'trials':>6} {'rapier':>7} {'mujoco':>7} {'agree':>6}   (mujoco {mujoco.__version__})")
    for name, (n, ours, theirs, same) in counts.items():
        print(f"{name:<12} {n:>6} {ours / n:>7.2f} {theirs / n:>7.2f} {same / n:>6.2f}")
    if a.json:
        with open(a.json, "w") as f:
            json.dump(rows, f, indent=1)
    n, _, _, same = counts["all"]
    return 0 if same >= 0.85 * n else 1


if __name__ == "__main__":
    sys.exit(main())
