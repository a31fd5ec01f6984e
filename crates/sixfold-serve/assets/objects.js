// The page Objects: what is stored, a mesh that can be rotated, adding and removing.

import { ask, byId, element, follow, json, Problem, run, showProblem } from "/static/api.js";

/** More faces than that are not sent to the page. */
const FACES = 60000;
let viewer = null;
let shown = null;

const millimetres = (metres) => `${(1000 * metres).toFixed(metres < 0.1 ? 1 : 0)} mm`;

function card(object) {
  const image = object.links.thumbnail
    ? element("img", { src: `${object.links.thumbnail}?${Date.now()}`, alt: "", loading: "lazy" })
    : element("div", { className: "blank" }, [object.error ? "damaged" : "known from depth images"]);
  const size = object.error ? "cannot be read" : millimetres(object.diameter);
  const text = element("div", { className: "text" }, [
    element("b", {}, [object.name]),
    element("span", { className: "muted small" }, [size]),
  ]);
  const made = element("button", { type: "button", className: "object", "aria-pressed": "false" }, [image, text]);
  made.dataset.name = object.name;
  made.addEventListener("click", () => open(object));
  return made;
}

async function list() {
  const { objects } = await json("/v1/objects");
  byId("cards").replaceChildren(...objects.map(card));
  byId("count").textContent = objects.length ? `${objects.length} stored` : "";
  byId("empty").hidden = objects.length > 0;
  byId("add-panel").open = objects.length === 0;
  return objects;
}

function facts(object) {
  const symmetries = [];
  if (object.symmetries_discrete) symmetries.push(`${object.symmetries_discrete + 1} poses look the same`);
  if (object.symmetries_continuous) symmetries.push("rotates freely about an axis");
  const bytes = (n) => {
    if (n < 1e3) return `${n} B`;
    return n < 1e6 ? `${(n / 1e3).toFixed(0)} kB` : `${(n / 1e6).toFixed(1)} MB`;
  };
  const pairs = [
    ["Diameter", millimetres(object.diameter)],
    ["Mesh", object.without_mesh ? "none" : `${object.vertices.toLocaleString("en")} vertices, ${object.faces.toLocaleString("en")} faces`],
    ["Symmetries", symmetries.join(", ") || "none known"],
    ["Source", `${object.source} (${object.source_unit})`],
    ["Files", object.files.map((file) => `${file.name} ${bytes(file.bytes)}`).join(", ")],
  ];
  return pairs.flatMap(([term, text]) => [element("dt", {}, [term]), element("dd", {}, [text])]);
}

function mark(name) {
  for (const made of document.querySelectorAll(".object")) {
    made.setAttribute("aria-pressed", String(made.dataset.name === name));
  }
}

async function open(object) {
  shown = object.name;
  mark(object.name);
  byId("objects-page").classList.add("open");
  byId("detail").hidden = false;
  byId("detail-name").textContent = object.name;
  byId("detail-status").replaceChildren();
  byId("facts").replaceChildren(...(object.error ? [] : facts(object)));
  byId("find-link").href = `/find?object=${encodeURIComponent(object.name)}`;
  byId("mesh-link").hidden = !object.links.mesh;
  byId("mesh-link").href = object.links.mesh || "#";
  byId("mesh-link").download = `${object.name}.ply`;
  showTraining(object);
  byId("viewer").hidden = byId("viewer-hint").hidden = !object.links.mesh;
  if (object.error) showProblem(byId("detail-status"), new Error(object.error));
  if (window.matchMedia("(max-width: 899px)").matches) byId("detail").scrollIntoView({ behavior: "instant" });
  if (object.links.mesh) await view(object);
}

async function view(object) {
  try {
    const { Viewer, parsePly } = await import("/static/viewer.js");
    const response = await ask(`${object.links.mesh}?faces=${FACES}`);
    const geometry = parsePly(await response.arrayBuffer());
    if (shown !== object.name) return;
    viewer ??= new Viewer(byId("viewer"));
    viewer.show(geometry);
    byId("viewer").dataset.shown = object.name;
  } catch (problem) {
    // A browser without WebGL: the image that the server renders.
    viewer = null;
    byId("viewer").replaceChildren(
      element("img", { src: object.links.thumbnail, alt: "" }),
      element("p", {}, [`It cannot be rotated here: ${problem.message}`]),
    );
  }
}

/** The trainings that this page follows: their jobs by the names of the objects. */
const followed = new Map();

function showTraining(object) {
  byId("training").hidden = !object.has_photographs;
  const running = followed.has(object.name);
  byId("training-hint").textContent = object.has_weights
    ? "A network of its own finds it in colour images (method pix2pose, and a part of auto)."
    : "It was taught from photographs. A network trained on new views of them finds it in colour images, partly occluded too. That takes a quarter of an hour or more; it continues if this page is closed.";
  byId("train").textContent = object.has_weights ? "Train again" : "Train a network";
  byId("train").hidden = running;
  byId("train-cancel").hidden = byId("train-bar").hidden = !running;
  byId("train-status").replaceChildren();
  if (running) showStep(followed.get(object.name));
}

function showStep(job) {
  const { step, done, total } = job.progress;
  byId("train-bar").firstElementChild.style.width = `${Math.max(4, 100 * done / (total || 1))}%`;
  byId("train-status").textContent = job.state === "queued" ? "Waiting for another training ..." : `${step} (${done} of ${total})`;
}

/** Shows the progress of a training while its object is the open one, until it ends. */
async function followTraining(name, job) {
  const open = () => shown === name;
  followed.set(name, job);
  if (open()) showTraining(await json(`/v1/objects/${encodeURIComponent(name)}`));
  try {
    const ended = await follow(job, (now) => {
      followed.set(name, now);
      if (open()) showStep(now);
    });
    followed.delete(name);
    const object = (await list()).find((o) => o.name === name);
    if (open() && object) {
      mark(name);
      byId("facts").replaceChildren(...(object.error ? [] : facts(object)));
      showTraining(object);
    }
    if (ended.state === "cancelled") throw new Problem({ error: "Cancelled. The next training of this object resumes where it stopped." }, 409);
    if (ended.state === "failed") throw new Problem(ended.error || {}, 422);
    if (open()) byId("train-status").replaceChildren(element("span", { className: "good" }, ["The network is trained and stored."]));
  } catch (problem) {
    followed.delete(name);
    if (open()) {
      byId("train").hidden = false;
      byId("train-cancel").hidden = byId("train-bar").hidden = true;
      showProblem(byId("train-status"), problem);
    }
  }
}

byId("train").addEventListener("click", async () => {
  const name = shown;
  try {
    const object = await json(`/v1/objects/${encodeURIComponent(name)}`);
    if (object.has_weights && !confirm(`Replace the network of ${name}?`)) return;
    const body = JSON.stringify({ replace: object.has_weights });
    const job = await json(`/v1/objects/${encodeURIComponent(name)}/training`, { method: "POST", body });
    await followTraining(name, job);
  } catch (problem) {
    showProblem(byId("train-status"), problem);
  }
});

byId("train-cancel").addEventListener("click", async () => {
  const job = followed.get(shown);
  if (!job) return;
  try {
    await ask(`${job.links.job}/cancel`, { method: "POST" });
  } catch (problem) {
    showProblem(byId("train-status"), problem);
  }
});

/** Follows the trainings that were started before this page was opened. */
async function resumeTrainings() {
  const { jobs } = await json("/v1/jobs");
  for (const job of jobs) {
    if (job.kind === "train" && ["queued", "running"].includes(job.state)) followTraining(job.object, job);
  }
}

function close() {
  shown = null;
  mark(null);
  byId("detail").hidden = true;
  byId("objects-page").classList.remove("open");
}

byId("close").addEventListener("click", close);

byId("remove").addEventListener("click", async () => {
  if (!confirm(`Remove ${shown} with all that was derived from it?`)) return;
  try {
    await ask(`/v1/objects/${encodeURIComponent(shown)}`, { method: "DELETE" });
    close();
    await list();
  } catch (problem) {
    showProblem(byId("detail-status"), problem);
  }
});

byId("add").addEventListener("submit", async (event) => {
  event.preventDefault();
  const status = byId("add-status");
  const form = new FormData();
  for (const [name, value] of new FormData(event.target)) {
    if (value instanceof File ? value.size : value) form.append(name, value);
  }
  const button = event.target.querySelector("button");
  button.disabled = true;
  status.textContent = "Sending ...";
  try {
    const { result } = await run("/v1/objects", form, (job) => {
      status.textContent = job.state === "queued" ? "Waiting ..." : `Working: ${job.progress.step} ...`;
    });
    status.replaceChildren(element("span", { className: "good" }, [`${result.name} is stored.`]));
    event.target.reset();
    const objects = await list();
    byId("add-panel").open = true;
    const added = objects.find((object) => object.name === result.name);
    if (added) await open(added);
  } catch (problem) {
    showProblem(status, problem);
  } finally {
    button.disabled = false;
  }
});

list()
  .then(resumeTrainings)
  .catch((problem) => showProblem(byId("cards"), problem));
