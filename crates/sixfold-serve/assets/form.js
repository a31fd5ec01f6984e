// What Find, Grasp and Teach share: files that are recognised by their content, and a job with its progress and result.

import { byId, element, json, run, showProblem } from "/static/api.js";

const KINDS = { rgb: "colour", depth: "depth", camera: "camera", mask: "mask" };

/** What a file is: a camera file is text, a depth image is a PNG with one channel of 16 bits. */
export async function kindOf(file) {
  const head = new Uint8Array(await file.slice(0, 32).arrayBuffer());
  const isPng = head[0] === 0x89 && head[1] === 0x50 && head[2] === 0x4e && head[3] === 0x47;
  // IHDR: bit depth and colour type.
  if (isPng && head[24] === 16 && head[25] === 0) return "depth";
  if (isPng) return /mask/i.test(file.name) ? "mask" : "rgb";
  if (head[0] === 0xff && head[1] === 0xd8) return "rgb";
  if (/\.(json|ya?ml|xml|txt)$/i.test(file.name)) return "camera";
  return "rgb";
}

/** Files that are dropped on the page, or chosen; `add` is called with each lot. */
export function dropZone(add) {
  const [drop, any] = [byId("drop"), byId("any")];
  drop.addEventListener("click", () => any.click());
  drop.addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      any.click();
    }
  });
  any.addEventListener("click", (event) => event.stopPropagation());
  any.addEventListener("change", async () => {
    const files = [...any.files];
    any.value = "";
    await add(files);
  });
  for (const name of ["dragenter", "dragover"]) {
    document.addEventListener(name, (event) => {
      event.preventDefault();
      drop.classList.add("over");
    });
  }
  document.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) drop.classList.remove("over");
  });
  document.addEventListener("drop", async (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    await add([...event.dataTransfer.files]);
  });
}

/** The files of a form: dropped or chosen, one of each kind. */
export class Files {
  constructor() {
    this.chosen = new Map();
    dropZone((files) => this.add(files));
  }

  async add(files) {
    for (const file of files) this.chosen.set(await kindOf(file), file);
    this.show();
  }

  show() {
    const rows = [...this.chosen].map(([kind, file]) => {
      const select = element("select", { "aria-label": `What ${file.name} is` });
      for (const [value, text] of Object.entries(KINDS)) {
        select.append(element("option", { value, selected: value === kind }, [text]));
      }
      select.addEventListener("change", () => {
        this.chosen.delete(kind);
        this.chosen.set(select.value, file);
        this.show();
      });
      const remove = element("button", { type: "button", className: "quiet", "aria-label": "Leave out" }, ["\u00d7"]);
      remove.addEventListener("click", () => {
        this.chosen.delete(kind);
        this.show();
      });
      return element("li", {}, [
        preview(kind, file),
        element("span", { className: "name", title: file.name }, [file.name]),
        select,
        remove,
      ]);
    });
    byId("files").replaceChildren(...rows);
  }

  /** Appends them to a form. */
  into(form) {
    for (const [kind, file] of this.chosen) form.append(kind, file, file.name);
  }
}

function preview(kind, file) {
  if (kind !== "rgb" && kind !== "mask") return element("span", { className: "badge" }, [kind === "depth" ? "16 bit" : "K"]);
  const image = element("img", { alt: "", src: URL.createObjectURL(file) });
  image.addEventListener("load", () => URL.revokeObjectURL(image.src));
  return image;
}

/** Text fields that are filled in, appended to a form. */
export function fields(form, names) {
  for (const name of names) {
    const input = document.forms[0].elements[name];
    const value = input.type === "checkbox" ? (input.checked ? input.value : "") : input.value.trim();
    if (value) form.append(name, value);
  }
}

/** The parts of a page that show a job. */
export function jobParts() {
  const parts = { status: byId("status"), progress: byId("progress"), row: byId("job-row"), go: byId("go") };
  return { ...parts, cancel: byId("cancel") };
}

/** Sends a form, shows progress, overlay, downloads; `table` makes the rest of the result. */
export async function work(path, form, table) {
  const parts = jobParts();
  byId("hint").hidden = true;
  for (const id of ["figure", "downloads"]) byId(id).hidden = true;
  byId("table").replaceChildren();
  byId("notes").replaceChildren();
  parts.status.replaceChildren("Sending ...");
  parts.go.disabled = true;
  // On a narrow screen the result lies below the form.
  if (window.matchMedia("(max-width: 899px)").matches) byId("result").scrollIntoView({ block: "nearest" });
  try {
    const { job, result } = await run(path, form, (now) => showState(parts, now));
    parts.status.replaceChildren();
    showResult(job, result, table);
  } catch (problem) {
    showProblem(parts.status, problem);
  } finally {
    parts.progress.hidden = parts.row.hidden = true;
    parts.go.disabled = false;
  }
}

/** Shows how far a job is. */
export function showState(parts, job) {
  const { done, total, step } = job.progress;
  parts.progress.hidden = parts.row.hidden = false;
  parts.cancel.onclick = () => json(`${job.links.job}/cancel`, { method: "POST" });
  const waiting = job.ahead ? `Waiting for ${job.ahead} other ${job.ahead === 1 ? "job" : "jobs"}` : "Waiting";
  parts.status.textContent = job.state === "queued" ? waiting : `Working: ${step} (${Math.min(done + 1, total)} of ${total})`;
  const part = job.state === "queued" || !total ? 0.04 : Math.max(0.08, done / total);
  parts.progress.firstElementChild.style.width = `${100 * part}%`;
}

function showResult(job, result, table) {
  if (job.links.overlay) {
    byId("overlay").src = job.links.overlay;
    byId("figure").hidden = false;
  }
  byId("table").replaceChildren(...table(result));
  byId("notes").replaceChildren(...(result.notes || []).map((note) => element("li", {}, [note])));
  const [dataLink, imageLink] = [byId("json"), byId("png")];
  dataLink.href = job.links.result;
  dataLink.download = `${job.kind}-${job.id.slice(0, 8)}.json`;
  imageLink.href = job.links.overlay || "#";
  imageLink.download = `${job.kind}-${job.id.slice(0, 8)}.png`;
  byId("downloads").hidden = false;
}

/** A table: `heads` as [text, is a number], rows of children. */
export function tableOf(heads, rows) {
  const className = (i) => (heads[i][1] ? "number" : "");
  const head = element("tr", {}, heads.map(([text], i) => element("th", { className: className(i) }, [text])));
  const body = rows.map((row) => element("tr", {}, row.map((cell, i) => element("td", { className: className(i) }, [cell].flat()))));
  return element("div", { className: "scroll" }, [
    element("table", {}, [element("thead", {}, [head]), element("tbody", {}, body)]),
  ]);
}
