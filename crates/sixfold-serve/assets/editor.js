// Correcting a photograph: its pose by dragging the mesh or by marking points, its mask with a brush.

import { ask, byId, element, json, showProblem } from "/static/api.js";
import { apply, cameraOf, identity, inverse, product, project, ray, rotationAbout, translation } from "/static/pose.js";

/** Images of at most this many pixels are corrected; masks are sent in this size. */
const SIDE = 1280;
const MESH = "rgb(0, 200, 255)";
/** Marks and masks: a colour that few objects have. */
const MARK = "rgb(225, 20, 130)";
/** Radians for a pixel of dragging. */
const ROTATION = 0.006;
/** Strokes that can be undone. */
const UNDOS = 20;

const HINTS = {
  pose: "Drag moves the mesh, with the right button or Shift it rotates, with Alt it rolls; the wheel changes the distance. Arrow keys move by a pixel.",
  points: "Mark a point of the object or the board in the other photograph, then the same point in this one. Three pairs or more give the pose.",
  mask: "Paint the object; with the right button or Shift the brush erases.",
};

function loaded(source) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.addEventListener("load", () => resolve(image));
    image.addEventListener("error", () => reject(new Error("an image cannot be loaded")));
    image.src = source;
  });
}

function offscreen(width, height) {
  const canvas = element("canvas", { width, height });
  return [canvas, canvas.getContext("2d", { willReadFrequently: true })];
}

/** A canvas that shows a part of a photograph, with lines over it. */
class Pane {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  /** Shows an image; `part` is [x, y, width, height] in its pixels. */
  show(image, part) {
    Object.assign(this, { image, part });
    const scale = Math.min(SIDE / Math.max(part[2], part[3]), 3);
    this.canvas.width = Math.round(part[2] * scale);
    this.canvas.height = Math.round(part[3] * scale);
    this.scale = this.canvas.width / part[2];
  }

  /** Draws the image, then what `over` draws in the image's pixels. */
  draw(over) {
    if (!this.image) return;
    const c = this.context;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = "#000";
    c.fillRect(0, 0, this.canvas.width, this.canvas.height);
    this.toImage(c);
    c.drawImage(this.image, 0, 0);
    over(c);
  }

  /** Sets a context to the image's pixels; their centres lie at whole numbers. */
  toImage(context) {
    context.setTransform(this.scale, 0, 0, this.scale, -this.part[0] * this.scale, -this.part[1] * this.scale);
  }

  /** The image's pixel under an event. */
  pixel(event) {
    const box = this.canvas.getBoundingClientRect();
    const k = this.part[2] / box.width;
    return [this.part[0] + (event.clientX - box.left) * k - 0.5, this.part[1] + (event.clientY - box.top) * k - 0.5];
  }

  /** A filled shape with a border around it, as wide on every screen. */
  outlined(path, color) {
    const { width, height } = this.canvas;
    const [shape, s] = offscreen(width, height);
    this.toImage(s);
    s.translate(0.5, 0.5);
    s.fillStyle = color;
    s.fill(path);
    const [border, b] = offscreen(width, height);
    const reach = Math.max(1.5, (2 * width) / Math.max(this.canvas.clientWidth, 300));
    for (let i = 0; i < 8; i++) b.drawImage(shape, reach * Math.cos(i * Math.PI / 4), reach * Math.sin(i * Math.PI / 4));
    b.globalCompositeOperation = "destination-out";
    b.drawImage(shape, 0, 0);
    const c = this.context;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.globalAlpha = 0.2;
    c.drawImage(shape, 0, 0);
    c.globalAlpha = 1;
    c.drawImage(border, 0, 0);
    this.toImage(c);
  }

  /** A numbered mark. */
  mark(pixel, number, color) {
    const c = this.context;
    const r = (7 * this.canvas.width) / Math.max(this.canvas.clientWidth, 300) / this.scale;
    const [x, y] = [pixel[0] + 0.5, pixel[1] + 0.5];
    c.beginPath();
    c.arc(x, y, r, 0, 2 * Math.PI);
    c.moveTo(x - 0.5 * r, y);
    c.lineTo(x + 0.5 * r, y);
    c.moveTo(x, y - 0.5 * r);
    c.lineTo(x, y + 0.5 * r);
    const label = [String(number), x + 1.2 * r, y - 0.6 * r];
    c.font = `bold ${2 * r}px sans-serif`;
    c.lineJoin = "round";
    // On white before its colour: it is seen on every ground.
    c.strokeStyle = "#fff";
    c.lineWidth = r / 1.6;
    c.stroke();
    c.strokeText(...label);
    c.strokeStyle = c.fillStyle = color;
    c.lineWidth = r / 4;
    c.stroke();
    c.fillText(...label);
  }
}

/** The dialog. `changed` is called with the teaching after each correction. */
export class Editor {
  constructor(changed) {
    this.changed = changed;
    this.pane = new Pane(byId("canvas"));
    this.other = new Pane(byId("reference"));
    this.dialog = byId("editor");
    this.drag = "move";
    this.brush = "add";
    this.listen();
  }

  /** Opens a photograph of a teaching. `shape` is the mesh, or null. */
  async open(teaching, number, shape) {
    Object.assign(this, { teaching, number, shape, pairs: [], point: null, strokes: [], pointers: new Map() });
    this.photograph = teaching.photographs[number];
    byId("editor-name").textContent = this.photograph.name;
    byId("editor-status").replaceChildren();
    const out = this.photograph.state === "left_out_by_person";
    byId("left-out").textContent = out ? "Take in" : "Leave out";
    byId("forget").hidden = this.photograph.pose_by !== "person" && this.photograph.mask_by !== "person";
    if (!this.dialog.open) this.dialog.showModal();
    this.image = await loaded(`${this.photograph.links.image}&side=${SIDE}`);
    const [width, height] = [this.image.naturalWidth, this.image.naturalHeight];
    this.camera = teaching.camera && cameraOf(teaching.camera, width, height);
    this.boardFromObject = teaching.mesh ? teaching.mesh.board_from_object : identity();
    const posed = teaching.photographs.filter((p) => p.camera_from_board);
    // One without a pose begins with another's.
    this.saved = this.photograph.camera_from_board || (posed[0] && posed[0].camera_from_board) || null;
    this.pose = this.saved;
    [this.mask, this.paint] = offscreen(width, height);
    if (this.photograph.links.mask) await this.loadMask();
    this.fillOthers(posed);
    byId("tab-pose").disabled = byId("tab-points").disabled = !this.camera || !this.pose;
    byId("mask-mesh").disabled = !this.shape || !this.pose || !this.camera;
    byId("whole").checked = false;
    this.tab(this.camera && this.pose ? "pose" : "mask");
    this.dialog.dataset.shown = String(number);
  }

  async loadMask() {
    const { width, height } = this.mask;
    this.paint.imageSmoothingEnabled = false;
    this.paint.drawImage(await loaded(this.photograph.links.mask), 0, 0, width, height);
    const data = this.paint.getImageData(0, 0, width, height);
    for (let i = 0; i < data.data.length; i += 4) {
      data.data[i + 3] = data.data[i] > 127 ? 255 : 0;
      [data.data[i], data.data[i + 1], data.data[i + 2]] = [225, 20, 130];
    }
    this.paint.putImageData(data, 0, 0);
  }

  fillOthers(posed) {
    const others = posed.filter((p) => p.number !== this.number);
    byId("other").replaceChildren(...others.map((p) => element("option", { value: p.number }, [p.name])));
    this.others = others;
  }

  tab(name) {
    this.tool = name;
    for (const tool of ["pose", "points", "mask"]) {
      byId(`tab-${tool}`).setAttribute("aria-selected", String(tool === name));
      byId(`tools-${tool}`).hidden = tool !== name;
    }
    byId("editor-hint").textContent = HINTS[name];
    byId("reference").hidden = name !== "points";
    byId("whole").parentElement.hidden = name === "points";
    this.dialog.classList.toggle("two", name === "points");
    if (name === "points") this.showOther().catch((problem) => showProblem(byId("editor-status"), problem));
    this.frame();
  }

  /** The pixels around the object, or all. */
  part() {
    const { naturalWidth: width, naturalHeight: height } = this.image;
    const all = [0, 0, width, height];
    if (byId("whole").checked || this.tool === "points" || !this.camera || !this.saved || !this.shape) return all;
    let [low, high] = [[Infinity, Infinity], [-Infinity, -Infinity]];
    const cameraFromObject = product(this.saved, this.boardFromObject);
    for (let i = 0; i < this.shape.positions.length / 3; i++) {
      const p = apply(cameraFromObject, this.shape.vertex(i));
      if (p[2] < 0.01) return all;
      const pixel = project(this.camera, p);
      low = low.map((v, k) => Math.min(v, pixel[k]));
      high = high.map((v, k) => Math.max(v, pixel[k]));
    }
    // In the proportions of the photograph, half as much again around the object.
    const w = Math.min(width, 1.6 * Math.max(high[0] - low[0], ((high[1] - low[1]) * width) / height));
    const h = (w * height) / width;
    const start = (middle, size, whole) => Math.min(Math.max(middle - size / 2, 0), Math.max(whole - size, 0));
    return [start((low[0] + high[0]) / 2, w, width), start((low[1] + high[1]) / 2, h, height), w, h];
  }

  frame() {
    this.pane.show(this.image, this.part());
    this.draw();
  }

  draw() {
    this.pane.draw((c) => {
      if (this.tool === "mask") {
        c.globalAlpha = 0.45;
        c.drawImage(this.mask, 0, 0);
        c.globalAlpha = 1;
      } else if (this.pose) {
        this.pane.outlined(this.outline(this.pose, this.camera), MESH);
      }
      if (this.tool === "points") this.pairs.forEach((pair, i) => this.pane.mark(pair.pixel, i + 1, MARK));
    });
    if (this.tool === "points" && this.otherCamera) {
      this.other.draw(() => {
        const marks = [...this.pairs.map((pair) => pair.seen), ...(this.point ? [this.point.seen] : [])];
        marks.forEach((pixel, i) => this.other.mark(pixel, i + 1, MARK));
      });
    }
    byId("points-save").disabled = this.pairs.length < 3;
  }

  /** The silhouette of the mesh; before there is one, the sheet. */
  outline(pose, camera) {
    if (this.shape) return this.shape.silhouette(camera, product(pose, this.boardFromObject));
    const path = new Path2D();
    const [[x0, y0], [x1, y1]] = this.teaching.board || [[-0.14, -0.1], [0.14, 0.1]];
    const corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
    corners.forEach(([x, y], i) => path[i ? "lineTo" : "moveTo"](...project(camera, apply(pose, [x, y, 0]))));
    path.closePath();
    return path;
  }

  /** Changes the pose by a transform of the camera's frame. */
  move(transform) {
    this.pose = product(transform, this.pose);
    this.draw();
  }

  pivot() {
    return apply(product(this.pose, this.boardFromObject), [0, 0, 0]);
  }

  dragged(how, dx, dy) {
    const p = this.pivot();
    if (how === "move") return this.move(translation((dx * p[2]) / this.camera.fx, (dy * p[2]) / this.camera.fy, 0));
    if (how === "roll") return this.move(rotationAbout(2, ROTATION * dx, p));
    const across = rotationAbout(1, -ROTATION * dx, p);
    return this.move(product(rotationAbout(0, ROTATION * dy, p), across));
  }

  farther(factor) {
    if (!this.pose) return;
    const p = this.pivot();
    const k = Math.min(Math.max(factor, 0.08 / p[2]), 8 / p[2]) - 1;
    this.move(translation(...p.map((v) => k * v)));
  }

  listen() {
    const canvas = this.pane.canvas;
    for (const tool of ["pose", "points", "mask"]) byId(`tab-${tool}`).addEventListener("click", () => this.tab(tool));
    const choose = (group, key) => byId(group).addEventListener("click", (event) => {
      const value = event.target.dataset[key];
      if (!value) return;
      this[key] = value;
      for (const button of byId(group).children) button.setAttribute("aria-pressed", String(button === event.target));
    });
    choose("drags", "drag");
    choose("brushes", "brush");
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      if (this.tool !== "pose") return;
      event.preventDefault();
      this.farther(Math.exp(0.0006 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      if (this.tool !== "pose" || !steps[event.key]) return;
      event.preventDefault();
      this.dragged(event.shiftKey ? "rotate" : this.drag, ...steps[event.key]);
    });
    this.other.canvas.addEventListener("pointerdown", (event) => this.markOther(event));
    byId("other").addEventListener("change", () => this.showOther());
    byId("nearer").addEventListener("click", () => this.farther(1 / 1.01));
    byId("farther").addEventListener("click", () => this.farther(1.01));
    byId("whole").addEventListener("change", () => this.frame());
    byId("editor-close").addEventListener("click", () => this.dialog.close());
    byId("pose-reset").addEventListener("click", () => {
      this.pose = this.saved;
      this.draw();
    });
    byId("points-undo").addEventListener("click", () => {
      if (this.point) this.point = null;
      else this.pairs.pop();
      this.draw();
    });
    this.listenForMask();
    this.listenForSaves();
  }

  listenForMask() {
    byId("mask-undo").addEventListener("click", () => {
      const before = this.strokes.pop();
      if (before) this.paint.putImageData(before, 0, 0);
      this.draw();
    });
    byId("mask-clear").addEventListener("click", () => {
      this.keepStroke();
      this.paint.clearRect(0, 0, this.mask.width, this.mask.height);
      this.draw();
    });
    byId("mask-mesh").addEventListener("click", () => {
      this.keepStroke();
      this.paint.clearRect(0, 0, this.mask.width, this.mask.height);
      this.paint.fillStyle = MARK;
      this.paint.save();
      this.paint.translate(0.5, 0.5);
      this.paint.fill(this.outline(this.pose, this.camera));
      this.paint.restore();
      this.draw();
    });
  }

  keepStroke() {
    this.strokes.push(this.paint.getImageData(0, 0, this.mask.width, this.mask.height));
    if (this.strokes.length > UNDOS) this.strokes.shift();
  }

  down(event) {
    event.preventDefault();
    this.pane.canvas.focus();
    if (this.tool === "points") return this.markThis(event);
    this.pane.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.tool === "mask") {
      this.keepStroke();
      this.stroke(event, this.pane.pixel(event));
    }
    return undefined;
  }

  moved(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (this.tool === "mask") {
      this.stroke(event, this.pane.pixel({ clientX: before[0], clientY: before[1] }));
    } else if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const far = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      this.farther(far(before) / far(now));
    } else {
      const k = this.pane.part[2] / this.pane.canvas.getBoundingClientRect().width;
      const how = event.altKey ? "roll" : event.shiftKey || event.buttons & 2 ? "rotate" : this.drag;
      const step = how === "move" ? k : 1;
      this.dragged(how, step * (now[0] - before[0]), step * (now[1] - before[1]));
    }
    this.pointers.set(event.pointerId, now);
  }

  stroke(event, from) {
    const to = this.pane.pixel(event);
    const erases = event.shiftKey || event.buttons & 2 || this.brush === "erase";
    const c = this.paint;
    c.globalCompositeOperation = erases ? "destination-out" : "source-over";
    c.strokeStyle = MARK;
    c.lineCap = "round";
    c.lineWidth = (Number(byId("brush-size").value) * this.pane.part[2]) / this.pane.canvas.getBoundingClientRect().width;
    c.beginPath();
    c.moveTo(from[0] + 0.5, from[1] + 0.5);
    c.lineTo(to[0] + 0.501, to[1] + 0.5);
    c.stroke();
    c.globalCompositeOperation = "source-over";
    this.draw();
  }

  async showOther() {
    const photograph = this.others.find((p) => p.number === Number(byId("other").value));
    if (!photograph) return;
    const image = await loaded(`${photograph.links.image}&side=${SIDE}`);
    this.otherPose = photograph.camera_from_board;
    this.otherCamera = cameraOf(this.teaching.camera, image.naturalWidth, image.naturalHeight);
    this.point = null;
    this.pairs.forEach((pair) => { pair.seen = project(this.otherCamera, apply(this.otherPose, pair.point)); });
    this.other.show(image, [0, 0, image.naturalWidth, image.naturalHeight]);
    this.draw();
  }

  /** A point of the mesh, or of the board beside it. */
  markOther(event) {
    event.preventDefault();
    const pixel = this.other.pixel(event);
    const boardFromCamera = inverse(this.otherPose);
    const eye = apply(boardFromCamera, [0, 0, 0]);
    const ahead = apply(boardFromCamera, ray(this.otherCamera, pixel));
    const direction = ahead.map((v, k) => v - eye[k]);
    let point = null;
    if (this.shape) {
      const objectFromBoard = inverse(this.boardFromObject);
      const origin = apply(objectFromBoard, eye);
      const there = apply(objectFromBoard, ahead);
      const hit = this.shape.hit(origin, there.map((v, k) => v - origin[k]));
      point = hit && apply(this.boardFromObject, hit);
    }
    if (!point && direction[2] < 0) point = eye.map((v, k) => v - (eye[2] / direction[2]) * direction[k]);
    if (point) this.point = { point, seen: pixel };
    this.draw();
  }

  markThis(event) {
    if (!this.point) {
      byId("editor-status").replaceChildren("Mark the point in the other photograph first.");
      return;
    }
    byId("editor-status").replaceChildren();
    this.pairs.push({ ...this.point, pixel: this.pane.pixel(event) });
    this.point = null;
    this.draw();
  }

  listenForSaves() {
    const to = (what) => `${this.teaching.links.photographs}/${this.number}/${what}`;
    const save = async (button, path, options, said) => {
      button.disabled = true;
      try {
        const teaching = await json(path, options());
        this.changed(teaching);
        await this.again(teaching, said);
      } catch (problem) {
        showProblem(byId("editor-status"), problem);
      } finally {
        button.disabled = false;
      }
    };
    const put = (body) => ({ method: "PUT", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    const on = (id, what, options, said) => {
      byId(id).addEventListener("click", () => save(byId(id), to(what), options, said));
    };
    on("pose-save", "pose", () => put({ camera_from_board: this.pose }), "The pose is saved.");
    on("points-save", "pose", () => put({ pairs: this.pairs.map((pair) => ({ point: pair.point, pixel: this.full(pair.pixel) })) }), "The pose is saved: check the outline.");
    on("left-out", "left_out", () => put({ left_out: this.photograph.state !== "left_out_by_person" }), "");
    on("forget", "corrections", () => ({ method: "DELETE" }), "The program will find pose and mask again.");
    byId("mask-save").addEventListener("click", async () => {
      const body = await this.maskPng();
      save(byId("mask-save"), to("mask"), () => ({ method: "PUT", headers: { "Content-Type": "image/png" }, body }), "The mask is saved.");
    });
  }

  /** Shows the photograph as it is after a correction, at the same tool. */
  async again(teaching, said) {
    const tool = this.tool === "points" ? "pose" : this.tool;
    await this.open(teaching, this.number, this.shape);
    if (tool !== this.tool && !byId(`tab-${tool}`).disabled) this.tab(tool);
    if (said) byId("editor-status").replaceChildren(element("span", { className: "good" }, [`${said} Close and continue to make what depends on it again.`]));
  }

  /** A pixel of the image in the photograph's full size. */
  full([u, v]) {
    const { width, height } = this.teaching.camera;
    return [((u + 0.5) * width) / this.image.naturalWidth - 0.5, ((v + 0.5) * height) / this.image.naturalHeight - 0.5];
  }

  /** The mask as a PNG, white on black. */
  maskPng() {
    const { width, height } = this.mask;
    const data = this.paint.getImageData(0, 0, width, height);
    for (let i = 0; i < data.data.length; i += 4) {
      const value = data.data[i + 3] > 127 ? 255 : 0;
      [data.data[i], data.data[i + 1], data.data[i + 2], data.data[i + 3]] = [value, value, value, 255];
    }
    const [canvas, context] = offscreen(width, height);
    context.putImageData(data, 0, 0);
    return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
  }
}

/** The mesh of a teaching, coarse enough to be dragged; null without one. */
export async function shapeOf(teaching, faces) {
  if (!teaching.mesh) return null;
  const [{ parsePly }, { Shape }] = await Promise.all([import("/static/viewer.js"), import("/static/pose.js")]);
  const response = await ask(`${teaching.mesh.link}&faces=${faces}`);
  return new Shape(parsePly(await response.arrayBuffer()));
}
