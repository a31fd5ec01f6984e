// The page Find: images and objects in, poses out.

import { byId, element, json, showProblem } from "/static/api.js";
import { Files, fields, tableOf, work } from "/static/form.js";

const files = new Files();
const TEXTS = ["fx", "fy", "cx", "cy", "depth_scale", "method", "instances", "min_confidence", "box"];

function choice(object, chosen) {
  const input = element("input", { type: "checkbox", name: "objects", value: object.name, checked: chosen.has(object.name) });
  const image = object.links.thumbnail
    ? element("img", { src: object.links.thumbnail, alt: "", loading: "lazy" })
    : element("span", { className: "blank" }, ["no mesh"]);
  return element("label", { className: "choice" }, [input, image, element("span", { className: "name" }, [object.name])]);
}

function certainty(pose) {
  if (pose.probability === undefined) return pose.confidence.toFixed(2);
  const percent = (value) => `${(100 * value).toFixed(0)} %`;
  const together = `${percent(pose.probability_with_alternatives)} one of ${pose.alternatives.length + 1} poses`;
  return percent(pose.probability) + (pose.alternatives.length ? ` (${together})` : "");
}

function found(result) {
  const status = [];
  if (result.poses.length === 0) status.push(element("p", {}, ["No pose was found with a sufficient confidence."]));
  if (result.not_found.length && result.poses.length) {
    status.push(element("p", { className: "muted" }, [`Not found: ${result.not_found.join(", ")}`]));
  }
  const rows = result.poses.map((pose) => {
    const swatch = element("span", { className: "swatch" });
    swatch.style.background = pose.color;
    const at = pose.camera_from_object.slice(0, 3).map((row) => (1000 * row[3]).toFixed(1));
    return [
      [swatch, pose.object],
      certainty(pose),
      pose.visibility === null ? "" : `${(100 * pose.visibility).toFixed(0)} %`,
      at.join("  "),
      pose.search_seconds.toFixed(2),
    ];
  });
  const sure = result.poses.some((pose) => pose.probability !== undefined) ? "Probability" : "Confidence";
  const heads = [["Object"], [sure, true], ["Visible", true], ["x  y  z (mm)", true], ["Time (s)", true]];
  return rows.length ? [tableOf(heads, rows), ...status] : status;
}

byId("form").addEventListener("submit", (event) => {
  event.preventDefault();
  const form = new FormData();
  files.into(form);
  fields(form, TEXTS);
  for (const input of document.querySelectorAll('input[name="objects"]:checked')) form.append("objects", input.value);
  work("/v1/find", form, found);
});

async function start() {
  const [{ objects }, { methods }] = await Promise.all([json("/v1/objects"), json("/v1/methods")]);
  const chosen = new Set(new URLSearchParams(location.search).getAll("object"));
  const choices = objects.filter((object) => !object.error).map((object) => choice(object, chosen));
  const none = element("span", { className: "muted" }, ["No objects yet: add one on the page Objects."]);
  byId("objects").replaceChildren(...(choices.length ? choices : [none]));
  const select = byId("method");
  select.replaceChildren(...methods.map((method) => element("option", { value: method.name }, [method.name])));
  const about = () => {
    const method = methods.find((m) => m.name === select.value);
    const needs = ["depth", "rgb", "region"].filter((input) => method[input] === "required");
    const words = { depth: "a depth image", rgb: "a colour image", region: "a box" };
    const text = needs.length ? ` Needs ${needs.map((n) => words[n]).join(" and ")}.` : "";
    byId("about").textContent = `${method.name}: ${method.about}.${text}`;
  };
  select.addEventListener("change", about);
  about();
}

start().catch((problem) => showProblem(byId("status"), problem));
