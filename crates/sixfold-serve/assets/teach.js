// The page Teach: photographs in, on the printed board or without one, a stored object out, with every step to be inspected and corrected.

import { ask, byId, element, follow, json, Problem, showProblem } from "/static/api.js";
import { Editor, shapeOf } from "/static/editor.js";
import { Ends } from "/static/ends.js";
import { dropZone, jobParts, kindOf, showState } from "/static/form.js";

/** Faces of the mesh as it is dragged, and as it is shown. */
const DRAGGED_FACES = 3000;
const SHOWN_FACES = 20000;
/** Photographs of one request. */
const MOST_AT_ONCE = 60;

const MESHES = /\.(ply|obj|stl|gltf|glb|xyz)$/i;

const chosen = { rgb: new Map(), depth: new Map(), camera: new Map(), mesh: new Map() };
const NAMES = {
  rgb: ["photograph", "photographs"], depth: ["depth image", "depth images"], camera: ["camera file", "camera files"], mesh: ["mesh", "meshes"],
};
const STATES = {
  ready: "to be continued", queued: "waiting", running: "working", failed: "stopped", taught: "to be inspected", accepted: "stored",
};
const parts = jobParts();
let shown = null;
let viewer = null;
let viewed = "";

const ends = new Ends(() => showScale());
const editor = new Editor((teaching) => show(teaching), ends);

function showChosen() {
  const rows = Object.entries(chosen).filter(([, files]) => files.size).map(([kind, files]) => {
    const remove = element("button", { type: "button", className: "quiet", "aria-label": "Leave out" }, ["\u00d7"]);
    remove.addEventListener("click", () => {
      files.clear();
      showChosen();
    });
    const text = `${files.size} ${NAMES[kind][files.size === 1 ? 0 : 1]}`;
    return element("li", {}, [element("span", { className: "name", title: [...files.keys()].join(", ") }, [text]), remove]);
  });
  byId("files").replaceChildren(...rows);
  byId("mesh-row").hidden = !chosen.mesh.size;
  byId("mesh-name").textContent = [...chosen.mesh.keys()].join();
  showActions();
}

async function choose(files) {
  for (const file of files) {
    const kind = MESHES.test(file.name) ? "mesh" : await kindOf(file);
    const place = chosen[kind === "mask" ? "rgb" : kind];
    // One of each of these.
    if (kind === "camera" || kind === "mesh") place.clear();
    place.set(file.name, file);
  }
  showChosen();
}

dropZone(choose);
byId("mesh-file").addEventListener("change", async () => {
  const files = [...byId("mesh-file").files];
  byId("mesh-file").value = "";
  await choose(files);
});

const input = (name) => document.forms[0].elements[name];
const withoutBoard = () => input("without_board").value === "true";

function showBoard() {
  byId("without-board-hint").hidden = !withoutBoard();
  byId("ruler-row").hidden = withoutBoard();
}

byId("form").addEventListener("change", () => {
  showBoard();
  showActions();
});

const rulerText = (teaching) => (teaching.ruler === null ? "" : String(Number(teaching.ruler.toFixed(3))));

/** The settings of the form, of which the shown teaching has others, as fields of a request. */
function settings(teaching) {
  const now = { without_board: String(withoutBoard()), hull_only: String(input("hull_only").checked) };
  const ruler = input("ruler").value.trim();
  if (ruler && !withoutBoard()) now.ruler = ruler;
  if (input("remove_mesh").checked) now.remove_mesh = "true";
  if (!teaching) return now;
  const before = { ...teaching, ruler: rulerText(teaching), remove_mesh: false };
  return Object.fromEntries(Object.entries(now).filter(([name, value]) => value !== String(before[name])));
}

/** Shows a teaching's settings in the form. */
function takeSettings(teaching) {
  input("without_board").value = String(teaching.without_board);
  input("hull_only").checked = teaching.hull_only;
  input("remove_mesh").checked = false;
  byId("remove-mesh-row").hidden = !teaching.given_mesh;
  input("ruler").value = rulerText(teaching);
  showBoard();
}

/** The chosen files in requests that the server takes, photographs with their depth, and the settings that a teaching does not have. */
async function batches(teaching = null) {
  const { max_upload: most } = await json("/v1/health");
  const sorted = (files) => [...files.values()].sort((a, b) => (a.name < b.name ? -1 : 1));
  const [photographs, depth] = [sorted(chosen.rgb), sorted(chosen.depth)];
  if (depth.length && depth.length !== photographs.length) {
    const error = `There are ${photographs.length} photographs and ${depth.length} depth images.`;
    throw new Problem({ error, advice: "Choose a depth image for every photograph." }, 0);
  }
  const all = [new FormData()];
  let [bytes, count] = [0, 0];
  photographs.forEach((file, i) => {
    const size = file.size + (depth[i] ? depth[i].size : 0) + 1000;
    if (count && (count >= MOST_AT_ONCE || bytes + size > 0.9 * most)) {
      all.push(new FormData());
      [bytes, count] = [0, 0];
    }
    const form = all[all.length - 1];
    form.append("photographs", file, file.name);
    if (depth[i]) form.append("depth", depth[i], depth[i].name);
    [bytes, count] = [bytes + size, count + 1];
  });
  for (const kind of ["camera", "mesh"]) for (const file of chosen[kind].values()) all[0].append(kind, file, file.name);
  if (chosen.mesh.size) all[0].append("unit", input("unit").value);
  for (const form of all) {
    const scale = input("depth_scale").value.trim() || "1";
    if (depth.length) form.append("depth_scale", scale);
  }
  for (const [name, value] of Object.entries(settings(teaching))) all[0].append(name, value);
  return all;
}

async function sendMore(teaching, forms) {
  for (const body of forms) await json(teaching.links.photographs, { method: "POST", body });
  for (const files of Object.values(chosen)) files.clear();
  showChosen();
}

byId("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  byId("hint").hidden = true;
  parts.status.replaceChildren("Sending ...");
  parts.go.disabled = true;
  try {
    const [first, ...more] = await batches();
    first.append("name", input("name").value.trim());
    first.delete("remove_mesh");
    if (input("replace").checked) first.append("replace", "true");
    first.append("start", "false");
    const teaching = await json("/v1/teachings", { method: "POST", body: first });
    history.pushState(null, "", `?id=${teaching.id}`);
    await sendMore(teaching, more);
    await runWithScale(await json(teaching.links.teaching));
  } catch (problem) {
    showProblem(parts.status, problem);
  } finally {
    parts.go.disabled = false;
    listEarlier();
  }
});

/** Starts a job of a teaching and follows it. */
async function run(teaching) {
  await started(teaching, await json(teaching.links.run, { method: "POST" }));
}

/** Whether a run can start: without a board the scale must be known. */
const hasScale = (teaching) =>
  !teaching.without_board || teaching.length !== null || teaching.photographs.some((p) => p.has_depth);

/** Runs a teaching, or shows it with what is missing. */
async function runWithScale(teaching) {
  if (hasScale(teaching)) {
    await run(teaching);
    return;
  }
  show(teaching);
  parts.status.replaceChildren("The photographs are stored. Mark the two ends of a measured length, then begin.");
}

const lengthText = (teaching) => (teaching.length === null ? "" : String(Number((1000 * teaching.length).toFixed(3))));

/** Whether length or ends are not on the server yet. */
const scaleIsNew = () => shown.without_board && (!ends.saved || byId("length").value.trim() !== lengthText(shown));

/** Sends length and ends. */
async function saveScale(teaching) {
  const form = new FormData();
  const text = byId("length").value.trim().replace(",", ".");
  const length = Number(text);
  if (text && !(length >= 5 && length <= 5000)) {
    throw new Problem({ error: `The length is "${text}".`, advice: "Give a number of millimetres, 5 to 5000." }, 0);
  }
  if (text) form.append("length", String(length / 1000));
  if (ends.list().length || !text) form.append("ends", JSON.stringify(ends.list()));
  const after = await json(teaching.links.photographs, { method: "POST", body: form });
  ends.keep();
  byId("length").value = lengthText(after);
  show(after);
  return after;
}

/** Follows a job; what is known is shown again with each of its steps. */
async function started(teaching, job) {
  const path = teaching.links.teaching;
  show(await json(path));
  if (window.matchMedia("(max-width: 899px)").matches) byId("result").scrollIntoView({ block: "start" });
  let step = "";
  try {
    const ended = await follow(job, (now) => {
      showState(parts, now);
      if (now.state !== "running" || now.progress.step === step) return;
      step = now.progress.step;
      json(path).then(show, () => {});
    });
    parts.status.replaceChildren(ended.state === "cancelled" ? "Cancelled; what was finished is kept." : "");
  } finally {
    parts.progress.hidden = parts.row.hidden = true;
  }
  const after = await json(path);
  show(after);
  if (after.problem) showProblem(parts.status, new Problem(after.problem, 422));
}

/** Runs what a button does; a problem is shown. */
function on(id, work) {
  byId(id).addEventListener("click", async () => {
    byId(id).disabled = true;
    parts.status.replaceChildren();
    try {
      await work(shown);
    } catch (problem) {
      showProblem(parts.status, problem);
    } finally {
      byId(id).disabled = false;
      showScale();
      listEarlier();
    }
  });
}

on("run", async (teaching) => run(scaleIsNew() ? await saveScale(teaching) : teaching));
on("more", async (teaching) => {
  await sendMore(teaching, await batches(teaching));
  const after = await json(teaching.links.teaching);
  takeSettings(after);
  await runWithScale(after);
});
on("scale-save", async (teaching) => {
  await saveScale(teaching);
  parts.status.replaceChildren(element("span", { className: "good" }, ["Length and ends are saved."]));
});
on("mark", async (teaching) => {
  const marked = ends.list().map((points) => points.photograph);
  await edit(marked.length ? marked[0] : 0, "ends");
});
byId("length").addEventListener("input", () => showScale());
on("accept", async (teaching) => {
  const job = await json(teaching.links.accept, { method: "POST" });
  await started(teaching, job);
  if (shown.state === "accepted") {
    parts.status.replaceChildren(element("span", { className: "good" }, [`${shown.object} is stored.`]));
  }
});
on("remove", async (teaching) => {
  if (!confirm(`Remove the photographs and corrections of ${teaching.name}? A stored object stays.`)) return;
  await ask(teaching.links.teaching, { method: "DELETE" });
  location.href = "/teach";
});

const millimetres = (metres) => (1000 * metres).toFixed(metres < 0.1 ? 1 : 0);
const percent = (fraction) => `${(100 * fraction).toFixed(0)} %`;

function symmetryText(symmetries) {
  const text = (s) => `${s.order ? `${s.order}-fold` : "any rotation"} about (${s.axis.map((v) => v.toFixed(2)).join(" ")})`;
  const sure = symmetries.filter((s) => s.sure).map(text);
  const perhaps = symmetries.filter((s) => !s.sure).map((s) => `perhaps ${text(s)}`);
  return [...sure, ...perhaps].join("; ") || "none";
}

function facts(teaching) {
  const used = teaching.photographs.filter((p) => !p.state.startsWith("left_out")).length;
  const pairs = [["Photographs", `${used} used of ${teaching.photographs.length}`]];
  if (teaching.rms !== null) {
    const text = teaching.without_board ? ["Features", "from where the poses put them"] : ["Tags", "from where the board has them"];
    pairs.push([text[0], `${teaching.rms.toFixed(2)} pixels ${text[1]}`]);
  }
  if (teaching.given_mesh) pairs.push(["Given mesh", "aligned with the photographs"]);
  const { mesh } = teaching;
  if (mesh) {
    const size = mesh.size.map(millimetres).join(" x ");
    pairs.push(["Size", `${size} mm, diameter ${millimetres(mesh.diameter)} mm`]);
    pairs.push(["Mesh", `${mesh.faces.toLocaleString("en")} faces${mesh.is_current ? "" : ", made before the corrections"}`]);
    pairs.push(["In no photograph", `${percent(mesh.unseen)} of the surface`]);
    pairs.push(["Symmetries", symmetryText(teaching.symmetries)]);
  }
  return pairs.flatMap(([term, text]) => [element("dt", {}, [term]), element("dd", {}, [text])]);
}

/** What is shown below a photograph; `text` is why it is left out. */
function captionOf(teaching, photograph) {
  const text = photograph.state.startsWith("left_out") ? photograph.reason || "left out" : "";
  const byPerson = ["pose", "mask"].filter((what) => photograph[`${what}_by`] === "person");
  const marked = teaching.without_board ? [0, 1].filter((end) => ends.of(photograph.number)[end]).map((end) => end + 1) : [];
  const notes = [
    byPerson.length ? `${byPerson.join(" and ")} corrected` : "",
    marked.length ? `${marked.length > 1 ? "ends" : "end"} ${marked.join(" and ")} marked` : "",
  ];
  const caption = text ? `left out: ${text}` : notes.filter(Boolean).join("; ");
  return { caption, text };
}

function tile(teaching, photograph) {
  const { caption, text } = captionOf(teaching, photograph);
  // Before the object is found the whole photograph is shown.
  const part = photograph.links.mask || teaching.mesh ? "side=220&close_up=true" : "side=320";
  const made = element("button", { type: "button", className: "tile" }, [
    element("img", { src: `${photograph.links.overlay}&${part}`, alt: "", loading: "lazy" }),
    element("span", { className: "name" }, [photograph.name]),
    element("span", { className: text ? "reason" : "muted small" }, [caption]),
  ]);
  made.dataset.number = photograph.number;
  made.classList.toggle("out", Boolean(text));
  made.addEventListener("click", () => edit(photograph.number));
  return made;
}

async function edit(number, tool) {
  try {
    await editor.open(shown, number, await shapeOf(shown, DRAGGED_FACES), tool);
  } catch (problem) {
    showProblem(byId("editor-status"), problem);
  }
}

/** The measured length, and in how many photographs its ends are marked. */
function showScale() {
  byId("scale").hidden = !shown.without_board || ["queued", "running"].includes(shown.state);
  const [first, second] = ends.counts();
  const photographs = (count) => `${count} photograph${count === 1 ? "" : "s"}`;
  const lacks = Math.min(first, second) < 2 ? " Each end has to be marked in two or more." : "";
  byId("marked").textContent = `End 1 is marked in ${photographs(first)}, end 2 in ${photographs(second)}.${lacks}`;
  byId("scale-save").disabled = !scaleIsNew();
  for (const place of byId("tiles").children) {
    const photograph = shown.photographs[Number(place.dataset.number)];
    const { caption, text } = captionOf(shown, photograph);
    if (!text) place.lastElementChild.textContent = caption;
  }
  showActions();
}

function showActions() {
  if (!shown) return;
  const busy = ["queued", "running"].includes(shown.state);
  const files = chosen.rgb.size + chosen.camera.size + chosen.mesh.size > 0;
  const changed = Object.keys(settings(shown)).length > 0;
  byId("actions").hidden = busy;
  byId("accept").hidden = shown.state !== "taught";
  byId("run").hidden = !["ready", "failed"].includes(shown.state) && !scaleIsNew();
  byId("run").disabled = !hasScale(shown) && !scaleIsNew();
  byId("run").textContent = shown.mesh || shown.rms !== null ? "Continue" : "Begin";
  byId("more").hidden = busy || !(files || changed);
  byId("more").textContent = files ? "Add the chosen files" : "Apply the settings";
  byId("find-link").hidden = !shown.object;
  byId("find-link").href = `/find?object=${encodeURIComponent(shown.object || "")}`;
}

function show(teaching) {
  const another = !shown || shown.id !== teaching.id;
  shown = teaching;
  ends.show(teaching);
  if (another) {
    byId("length").value = lengthText(teaching);
    takeSettings(teaching);
  }
  byId("hint").hidden = true;
  byId("teaching").hidden = false;
  byId("name").textContent = teaching.name;
  byId("state").textContent = STATES[teaching.state];
  byId("state").dataset.state = teaching.state;
  byId("facts").replaceChildren(...facts(teaching));
  byId("legend").hidden = !teaching.mesh;
  byId("tiles").replaceChildren(...teaching.photographs.map((photograph) => tile(teaching, photograph)));
  byId("remove-mesh-row").hidden = !teaching.given_mesh;
  showScale();
  view(teaching);
}

/** The mesh, where it is another one than the one that is shown. */
async function view(teaching) {
  const place = byId("viewer");
  place.hidden = !teaching.mesh;
  const key = teaching.mesh && teaching.mesh.is_current ? teaching.mesh.link : viewed;
  if (!teaching.mesh || key === viewed) return;
  viewed = key;
  try {
    const { Viewer, parsePly } = await import("/static/viewer.js");
    const response = await ask(`${teaching.mesh.link}&faces=${SHOWN_FACES}`);
    const geometry = parsePly(await response.arrayBuffer());
    viewer ??= new Viewer(place);
    viewer.show(geometry);
  } catch (problem) {
    viewer = null;
    place.replaceChildren(element("p", {}, [`The mesh cannot be shown here: ${problem.message}`]));
  }
}

async function listEarlier() {
  const { teachings } = await json("/v1/teachings");
  const rows = teachings.map((teaching) => {
    const state = element("span", { className: "muted small" }, [`${teaching.photographs} photographs, ${STATES[teaching.state]}`]);
    return element("li", {}, [element("a", { href: `/teach?id=${teaching.id}` }, [teaching.name]), " ", state]);
  });
  byId("earlier").replaceChildren(...rows);
  byId("earlier-part").hidden = rows.length === 0;
}

async function start() {
  const id = new URLSearchParams(location.search).get("id");
  if (id) {
    const teaching = await json(`/v1/teachings/${encodeURIComponent(id)}`);
    show(teaching);
    if (teaching.problem) showProblem(parts.status, new Problem(teaching.problem, 422));
    if (["queued", "running"].includes(teaching.state)) started(teaching, teaching.job).catch((e) => showProblem(parts.status, e));
  }
  await listEarlier();
}

start().catch((problem) => showProblem(parts.status, problem));
