// A mesh that can be rotated. The mesh is the server's binary PLY: float positions, perhaps normals and colours; triangles.

import {
  AmbientLight, BufferAttribute, BufferGeometry, DirectionalLight, DoubleSide, Mesh, MeshLambertMaterial, PerspectiveCamera,
  Quaternion, Scene, Vector3, WebGLRenderer,
} from "/static/vendor/three.min.js";

const SIZES = { float: 4, uchar: 1, int: 4 };

/** The geometry of a PLY file as the server writes it. */
export function parsePly(buffer) {
  const start = new TextDecoder("ascii").decode(buffer.slice(0, 4096));
  const end = start.indexOf("end_header\n");
  if (!start.startsWith("ply\nformat binary_little_endian") || end < 0) throw new Error("not a binary PLY file");
  const counts = {};
  const properties = [];
  let of = "";
  for (const line of start.slice(0, end).split("\n")) {
    const words = line.split(" ");
    if (words[0] === "element") [of, counts[words[1]]] = [words[1], Number(words[2])];
    if (words[0] === "property" && of === "vertex") properties.push([words[2], words[1]]);
  }
  const offsets = {};
  let stride = 0;
  for (const [name, type] of properties) {
    offsets[name] = stride;
    stride += SIZES[type];
  }
  const view = new DataView(buffer);
  const vertices = counts.vertex;
  const first = end + "end_header\n".length;
  const positions = new Float32Array(3 * vertices);
  const colors = "red" in offsets ? new Float32Array(3 * vertices) : null;
  for (let i = 0; i < vertices; i++) {
    const at = first + i * stride;
    ["x", "y", "z"].forEach((name, axis) => {
      positions[3 * i + axis] = view.getFloat32(at + offsets[name], true);
    });
    // The renderer computes in linear colours.
    if (colors) ["red", "green", "blue"].forEach((name, c) => {
      colors[3 * i + c] = (view.getUint8(at + offsets[name]) / 255) ** 2.2;
    });
  }
  const faces = new Uint32Array(3 * (counts.face || 0));
  let at = first + vertices * stride;
  for (let i = 0; i < faces.length; i += 3, at += 13) {
    for (let k = 0; k < 3; k++) faces[i + k] = view.getUint32(at + 1 + 4 * k, true);
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  if (colors) geometry.setAttribute("color", new BufferAttribute(colors, 3));
  geometry.setIndex(new BufferAttribute(faces, 1));
  geometry.computeVertexNormals();
  geometry.computeBoundingBox();
  return geometry;
}

/** A view of one mesh in a place of the page: rotated by dragging and arrow keys, zoomed by wheel and pinch. */
export class Viewer {
  constructor(place) {
    this.place = place;
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(35, 1, 0.001, 100);
    this.scene.add(new AmbientLight(0xffffff, 1.6));
    // From the camera, so that what faces it is bright in any orientation of the object.
    const light = new DirectionalLight(0xffffff, 2.2);
    light.position.set(0.4, 0.6, 1);
    this.scene.add(light);
    this.pointers = new Map();
    this.canvas = this.renderer.domElement;
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("aria-label", "The object; drag or use the arrow keys to rotate it");
    place.replaceChildren(this.canvas);
    this.listen();
    this.watched = new ResizeObserver(() => this.draw());
    this.watched.observe(place);
  }

  /** Shows a geometry, z up, from above and in front. */
  show(geometry) {
    if (this.mesh) this.scene.remove(this.mesh);
    const material = new MeshLambertMaterial({ side: DoubleSide, vertexColors: "color" in geometry.attributes });
    if (!material.vertexColors) material.color.set(0x9aa7b5);
    this.mesh = new Mesh(geometry, material);
    const box = geometry.boundingBox;
    const center = box.getCenter(new Vector3());
    this.radius = 0.5 * box.getSize(new Vector3()).length() || 0.1;
    geometry.translate(-center.x, -center.y, -center.z);
    this.mesh.quaternion
      .setFromAxisAngle(new Vector3(1, 0, 0), -Math.PI / 3)
      .multiply(new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), Math.PI / 6));
    this.scene.add(this.mesh);
    this.distance = this.radius / Math.sin((17.5 * Math.PI) / 180);
    this.draw();
  }

  /** Turns the object about the screen's axes, radians. */
  turn(right, down) {
    if (!this.mesh) return;
    const about = (axis, angle) => new Quaternion().setFromAxisAngle(axis, angle);
    this.mesh.quaternion.premultiply(about(new Vector3(0, 1, 0), right)).premultiply(about(new Vector3(1, 0, 0), down));
    this.draw();
  }

  zoom(factor) {
    if (!this.mesh) return;
    this.distance = Math.min(Math.max(this.distance * factor, 1.2 * this.radius), 20 * this.radius);
    this.draw();
  }

  draw() {
    const [width, height] = [this.place.clientWidth, this.place.clientHeight];
    if (!this.mesh || !width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.near = 0.01 * this.radius;
    this.camera.far = 40 * this.radius;
    this.camera.position.set(0, 0, this.distance);
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
  }

  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(0.0012 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
      if (steps[event.key]) {
        event.preventDefault();
        this.turn(...steps[event.key]);
      }
    });
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const far = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      this.zoom(far(before) / far(now));
    } else {
      this.turn(0.01 * (now[0] - before[0]), 0.01 * (now[1] - before[1]));
    }
    this.pointers.set(event.pointerId, now);
  }
}
