// Correcting a photograph: its pose by dragging the mesh or by marking points, its mask with a brush; and the two ends of a measured
// length, for photographs without a board.

import { ask, byId, element, json, showProblem } from "/static/api.js";
import { apply, cameraOf, identity, inverse, product, project, ray, rotationAbout, translation } from "/static/pose.js";

/** Images of at most this many pixels are corrected; masks are sent in this size. */
const SIDE = 1280;
const MESH = "rgb(0, 200, 255)";
/** Marks and masks: a colour that few objects have. */
const MARK = "rgb(225, 20, 130)";
/** Radians for a pixel of dragging. */
const ROTATION = 0.006;
/** Images in which ends are marked have at most this many pixels. */
const FINE_SIDE = 2048;
/** A mark is taken hold of within this distance, pixels of the screen. */
const REACH = 14;
/** The smallest part of a photograph that is shown, pixels. */
const CLOSEST = 40;
/** Strokes that can be undone. */
const UNDOS = 20;

const TOOLS = ["ends", "pose", "points", "mask"];
const HINTS = {
  ends: "Click at the two ends of the measured length; drag a mark to move it. The wheel zooms. Leave out an end that the photograph does not show.",
  pose: "Drag moves the mesh, with the right button or Shift it rotates, with Alt it rolls; the wheel changes the distance. Arrow keys move by a pixel.",
  points: "Mark a point of the object or of the ground beside it in the other photograph, then the same point in this one. Three pairs or more give the pose.",
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

  /** Shows an image, enlarged at most so many times; `part` is [x, y, width, height] in its pixels. */
  show(image, part, most = 3) {
    Object.assign(this, { image, part });
    const scale = Math.min(SIDE / Math.max(part[2], part[3]), most);
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

/** The dialog. `changed` is called with the teaching after each correction; `ends` keeps the marks of the measured length. */
export class Editor {
  constructor(changed, ends) {
    this.changed = changed;
    this.ends = ends;
    this.end = 0;
    this.pane = new Pane(byId("canvas"));
    this.other = new Pane(byId("reference"));
    this.dialog = byId("editor");
    this.drag = "move";
    this.brush = "add";
    this.listen();
  }

  /** Opens a photograph of a teaching. `shape` is the mesh, or null. */
  async open(teaching, number, shape, tool = null) {
    Object.assign(this, { teaching, number, shape, pairs: [], point: null, strokes: [], pointers: new Map() });
    this.photograph = teaching.photographs[number];
    Object.assign(this, { taken: null, held: null });
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
    byId("tab-ends").hidden = !teaching.without_board;
    const usual = this.camera && this.pose ? "pose" : teaching.without_board ? "ends" : "mask";
    await this.tab(tool || usual);
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

  async tab(name) {
    this.tool = name;
    for (const tool of TOOLS) {
      byId(`tab-${tool}`).setAttribute("aria-selected", String(tool === name));
      byId(`tools-${tool}`).hidden = tool !== name;
    }
    byId("editor-hint").textContent = HINTS[name];
    byId("reference").hidden = name !== "points";
    byId("whole").parentElement.hidden = name === "points" || name === "ends";
    this.dialog.classList.toggle("two", name === "points");
    try {
      if (name === "points") await this.showOther();
      if (name === "ends") await this.showTaken();
    } catch (problem) {
      showProblem(byId("editor-status"), problem);
    }
    this.frame();
  }

  /** The photograph with its lens distortion, for the ends of the length. */
  async showTaken() {
    const number = this.number;
    const image = await loaded(`${this.photograph.links.image}&side=${FINE_SIDE}&as_taken=true`);
    if (number !== this.number) return;
    this.taken = image;
    const [first, second] = this.ends.of(number);
    this.chooseEnd(first && !second ? 1 : 0);
    byId("ends-previous").disabled = number === 0;
    byId("ends-next").disabled = number + 1 === this.teaching.photographs.length;
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
    if (this.tool === "ends") {
      if (this.taken) this.pane.show(this.taken, [0, 0, this.taken.naturalWidth, this.taken.naturalHeight], Infinity);
    } else {
      this.pane.show(this.image, this.part());
    }
    this.draw();
  }

  draw() {
    this.pane.draw((c) => {
      if (this.tool === "ends") {
        this.marks().forEach((pixel, end) => pixel && this.pane.mark(pixel, end + 1, MARK));
      } else if (this.tool === "mask") {
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
    for (const tool of TOOLS) byId(`tab-${tool}`).addEventListener("click", () => this.tab(tool));
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
      canvas.addEventListener(name, (event) => {
        this.pointers.delete(event.pointerId);
        this.held = null;
      });
    }
    canvas.addEventListener("wheel", (event) => {
      if (this.tool === "ends") {
        event.preventDefault();
        this.zoom(Math.exp(0.0015 * event.deltaY), this.pane.pixel(event));
      }
      if (this.tool !== "pose") return;
      event.preventDefault();
      this.farther(Math.exp(0.0006 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      if (this.tool === "ends") this.endKey(event, steps[event.key]);
      if (this.tool !== "pose" || !steps[event.key]) return;
      event.preventDefault();
      this.dragged(event.shiftKey ? "rotate" : this.drag, ...steps[event.key]);
    });
    this.other.canvas.addEventListener("pointerdown", (event) => this.markOther(event));
    byId("other").addEventListener("change", () => this.showOther());
    byId("nearer").addEventListener("click", () => this.farther(1 / 1.01));
    byId("farther").addEventListener("click", () => this.farther(1.01));
    byId("whole").addEventListener("change", () => this.frame());
    // Marks are as large on every screen.
    window.addEventListener("resize", () => this.dialog.open && this.draw());
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
    this.listenForEnds();
    this.listenForMask();
    this.listenForSaves();
  }

  listenForEnds() {
    byId("ends").addEventListener("click", (event) => {
      if (event.target.dataset.end) this.chooseEnd(Number(event.target.dataset.end));
    });
    byId("end-remove").addEventListener("click", () => this.setEnd(null));
    byId("zoom-in").addEventListener("click", () => this.zoom(0.5));
    byId("zoom-out").addEventListener("click", () => this.zoom(2));
    const open = (number) => this.open(this.teaching, number, this.shape, "ends").catch((problem) => showProblem(byId("editor-status"), problem));
    byId("ends-previous").addEventListener("click", () => open(this.number - 1));
    byId("ends-next").addEventListener("click", () => open(this.number + 1));
  }

  /** Which end clicks and keys are about. */
  chooseEnd(end) {
    this.end = end;
    for (const button of byId("ends").children) button.setAttribute("aria-pressed", String(Number(button.dataset.end) === end));
    byId("end-remove").disabled = !this.ends.of(this.number)[end];
  }

  /** The marked ends in pixels of the shown image. */
  marks() {
    if (!this.taken) return [null, null];
    const [kx, ky] = this.fromFull();
    return this.ends.of(this.number).map((p) => p && [(p[0] + 0.5) * kx - 0.5, (p[1] + 0.5) * ky - 0.5]);
  }

  /** Width and height of the photograph. */
  fullSize() {
    return [this.photograph.width || this.taken.naturalWidth, this.photograph.height || this.taken.naturalHeight];
  }

  /** Pixels of the shown image for a pixel of the photograph. */
  fromFull() {
    const [width, height] = this.fullSize();
    return [this.taken.naturalWidth / width, this.taken.naturalHeight / height];
  }

  /** Marks the chosen end at a pixel of the shown image, or removes its mark. */
  setEnd(pixel) {
    if (!this.taken) return;
    const [kx, ky] = this.fromFull();
    const [width, height] = this.fullSize();
    const within = (v, size) => Math.min(Math.max(v, -0.5), size - 0.5);
    const full = pixel && [within((pixel[0] + 0.5) / kx - 0.5, width), within((pixel[1] + 0.5) / ky - 0.5, height)];
    this.ends.set(this.number, this.end, full);
    this.chooseEnd(this.end);
    this.draw();
  }

  /** Takes hold of a mark, or sets the chosen one; after the first of two the other is chosen. */
  endDown(event) {
    const pixel = this.pane.pixel(event);
    const k = this.pane.part[2] / this.pane.canvas.getBoundingClientRect().width;
    const far = (mark) => (mark ? Math.hypot(mark[0] - pixel[0], mark[1] - pixel[1]) / k : Infinity);
    const distances = this.marks().map(far);
    const nearest = distances[1] < distances[0] ? 1 : 0;
    if (distances[nearest] < REACH) {
      const mark = this.marks()[nearest];
      this.chooseEnd(nearest);
      // It moves with the pointer and does not jump to it.
      this.held = [mark[0] - pixel[0], mark[1] - pixel[1]];
      return;
    }
    const other = 1 - this.end;
    if (this.ends.of(this.number)[this.end] && !this.ends.of(this.number)[other]) this.chooseEnd(other);
    this.setEnd(pixel);
    this.held = [0, 0];
  }

  endKey(event, step) {
    const mark = this.marks()[this.end];
    if (!mark) return;
    if (event.key === "Delete" || event.key === "Backspace") this.setEnd(null);
    else if (step) this.setEnd([mark[0] + step[0] * this.fromFull()[0], mark[1] + step[1] * this.fromFull()[1]]);
    else return;
    event.preventDefault();
  }

  /** Shows a larger or a smaller part of the photograph; `at` stays where it is on the screen. */
  zoom(factor, at = this.marks()[this.end]) {
    if (!this.taken) return;
    const { naturalWidth: width, naturalHeight: height } = this.taken;
    const [x, y, w, h] = this.pane.part;
    const wide = Math.min(Math.max(w * factor, CLOSEST), width);
    const k = wide / w;
    const centre = at || [x + w / 2, y + h / 2];
    const start = (low, c, size, whole) => Math.min(Math.max(c - (c - low) * k, 0), whole - size);
    const high = Math.min(h * k, height);
    this.pane.show(this.taken, [start(x, centre[0], wide, width), start(y, centre[1], high, height), wide, high], Infinity);
    this.draw();
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
    if (this.tool === "ends" && (!this.taken || event.button)) return undefined;
    this.pane.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.tool === "ends") this.endDown(event);
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
    if (this.tool === "ends") {
      if (!this.held) return;
      this.setEnd(this.pane.pixel(event).map((v, k) => v + this.held[k]));
    } else if (this.tool === "mask") {
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

  /** A point of the mesh, or of the board or the ground beside it. */
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
    const height = eye[2] - (this.teaching.floor || 0);
    if (!point && direction[2] < 0) point = eye.map((v, k) => v - (height / direction[2]) * direction[k]);
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
    if (tool !== this.tool && !byId(`tab-${tool}`).disabled) await this.tab(tool);
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
