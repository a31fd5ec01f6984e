// The page Grasp: a depth image in, grasps out.

import { byId, element, json, showProblem } from "/static/api.js";
import { Files, fields, tableOf, work } from "/static/form.js";

const files = new Files();
const TEXTS = ["fx", "fy", "cx", "cy", "depth_scale", "gripper", "number", "seen_only"];

function proposed(result) {
  if (!result.grasps.length) return [element("p", {}, [`No grasp was found for the gripper ${result.gripper}.`])];
  const rows = result.grasps.map((grasp, i) => [
    String(i + 1),
    grasp.quality.toFixed(2),
    (1000 * grasp.width).toFixed(0),
    (1000 * grasp.opening).toFixed(0),
    grasp.camera_from_gripper.slice(0, 3).map((row) => (1000 * row[3]).toFixed(1)).join("  "),
  ]);
  return [tableOf([["Grasp"], ["Quality", true], ["Width (mm)", true], ["Opening (mm)", true], ["Tips: x  y  z (mm)", true]], rows)];
}

byId("form").addEventListener("submit", (event) => {
  event.preventDefault();
  const form = new FormData();
  files.into(form);
  fields(form, TEXTS);
  work("/v1/grasps", form, proposed);
});

json("/v1/methods")
  .then(({ grippers }) => {
    byId("gripper").replaceChildren(...grippers.map((name) => element("option", { value: name }, [name])));
  })
  .catch((problem) => showProblem(byId("status"), problem));
