// Drives the pages of `sixfold serve` in a real browser, as a user would: adds an object, turns it, finds it in the demo's frame,
// downloads the result, proposes grasps; teaches an object from photographs, corrects a pose and a mask, accepts it, finds it in
// another image; teaches one without a board, with a length marked by mouse, then with a mesh; at a wide and a narrow size, with an
// image of each page; starts and cancels a training.
//
//   npm install                                       (in this folder or a copy of it)
//   cargo run --release -p sixfold-teach --example photographs -- data/demo/models/obj_000009.ply mm PHOTOGRAPHS
//   cargo run --release -p sixfold-teach --example photographs -- data/demo/models/obj_000009.ply mm CLOTH 16 cloth
//   node pages.mjs SIXFOLD DEMO OUT PHOTOGRAPHS CLOTH [CHROMIUM]
//
// SIXFOLD is the program built with the feature `serve`, DEMO the folder data/demo, OUT a folder for images.
// Exits with 1 and a message at the first thing that is not as it should be.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { mkdtemp, mkdir, readFile, readdir, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

const [program, demo, out, photographs, cloth, browserPath = "/usr/bin/chromium"] = process.argv.slice(2);
assert(program && demo && out && photographs && cloth, "usage: node pages.mjs SIXFOLD DEMO OUT PHOTOGRAPHS CLOTH [CHROMIUM]");

const SIZES = { wide: { width: 1280, height: 860 }, narrow: { width: 390, height: 844 } };
const frame = ["depth/000003.png", "rgb/000003.png"].map((file) => join(demo, "test/000002", file));
const files = [...frame, join(demo, "camera.json")];

/** Starts the server on a free port; its address. */
async function serve(folder) {
  const server = spawn(program, ["serve", "--port", "0", "--store", join(folder, "objects"), "--data", join(folder, "data")]);
  const address = await new Promise((resolve, reject) => {
    let text = "";
    server.stdout.on("data", (data) => {
      text += data;
      const found = text.match(/http:\/\/[\d.:]+/);
      if (found) resolve(found[0]);
    });
    server.stderr.on("data", (data) => process.stderr.write(data));
    server.on("exit", (code) => reject(new Error(`the server ended with ${code}`)));
  });
  return { server, address };
}

/** Stores one of the demo's models over the API. */
async function store(address, name, id) {
  const mesh = await readFile(join(demo, `models/obj_${String(id).padStart(6, "0")}.ply`));
  const form = new FormData();
  form.append("name", name);
  form.append("unit", "mm");
  form.append("mesh", new Blob([mesh]), "model.ply");
  const job = await (await fetch(`${address}/v1/objects`, { method: "POST", body: form })).json();
  const result = await fetch(`${address}/v1/jobs/${job.id}/result?wait=60`);
  assert.equal(result.status, 200, `storing ${name}`);
}

async function shot(page, name) {
  for (const [size, viewport] of Object.entries(SIZES)) {
    await page.setViewportSize(viewport);
    await page.evaluate(() => window.scrollTo(0, 0));
    await page.waitForTimeout(250);
    const wide = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
    assert.equal(wide, 0, `${name}, ${size}: the page is wider than its window`);
    await page.screenshot({ path: join(out, `${name}-${size}.png`), fullPage: true });
  }
  await page.setViewportSize(SIZES.wide);
}

/** How many pixels of the viewer's canvas are not empty, and a number that changes when the image does. */
const canvas = (page) => page.evaluate(() => {
  const shown = document.querySelector("#viewer canvas");
  const copy = new OffscreenCanvas(shown.width, shown.height).getContext("2d");
  copy.drawImage(shown, 0, 0);
  const { data } = copy.getImageData(0, 0, shown.width, shown.height);
  let [covered, sum] = [0, 0];
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] > 0) covered += 1;
    sum = (sum * 31 + data[i] + 3 * data[i + 1]) % 1000003;
  }
  return { fraction: covered / (data.length / 4), sum };
});

async function objects(page, address) {
  await page.goto(address);
  await page.getByText("There are no objects yet").waitFor();
  await page.getByRole("textbox", { name: "Name" }).fill("duck");
  await page.locator('input[name="mesh"]').setInputFiles(join(demo, "models/obj_000009.ply"));
  await page.getByRole("button", { name: "Add", exact: true }).click();
  await page.getByText("duck is stored.").waitFor({ timeout: 60000 });
  for (const [name, id] of [["driller", 8], ["cat", 6], ["eggbox", 10]]) await store(address, name, id);
  await page.reload();
  await page.locator('.object[data-name="driller"]').click();
  await page.locator('#viewer[data-shown="driller"]').waitFor({ timeout: 30000 });
  const before = await canvas(page);
  assert(before.fraction > 0.05 && before.fraction < 0.9, `the mesh covers ${before.fraction} of the viewer`);
  const box = await page.locator("#viewer canvas").boundingBox();
  await page.mouse.move(box.x + 100, box.y + 100);
  await page.mouse.down();
  await page.mouse.move(box.x + 220, box.y + 130, { steps: 5 });
  await page.mouse.up();
  assert.notEqual((await canvas(page)).sum, before.sum, "dragging turns the mesh");
  await shot(page, "objects");
  // A name that cannot be is refused with advice.
  await page.locator("#add-panel summary").click();
  await page.getByRole("textbox", { name: "Name" }).fill("my duck");
  await page.locator('input[name="mesh"]').setInputFiles(join(demo, "models/obj_000009.ply"));
  await page.getByRole("button", { name: "Add", exact: true }).click();
  await page.locator("#add-status .problem").waitFor();
  assert.match(await page.locator("#add-status").innerText(), /letters, digits/);
}

async function find(page, address) {
  await page.goto(`${address}/find?object=duck`);
  await page.locator("#any").setInputFiles(files);
  await page.locator("#files li").nth(2).waitFor();
  const kinds = await page.locator("#files select").evaluateAll((all) => all.map((select) => select.value));
  assert.deepEqual(kinds.sort(), ["camera", "depth", "rgb"]);
  assert(await page.locator('input[value="duck"]').isChecked());
  await page.locator(".choice", { hasText: "driller" }).click();
  await page.getByRole("button", { name: "Find", exact: true }).click();
  await page.locator("#table tbody tr").nth(1).waitFor({ timeout: 300000 });
  await page.locator("#overlay").evaluate((image) => image.decode());
  assert.equal(await page.locator("#overlay").evaluate((image) => image.naturalWidth), 640);
  const rows = await page.locator("#table tbody tr").allInnerTexts();
  assert(rows.some((row) => row.includes("duck")) && rows.some((row) => row.includes("driller")), rows.join("; "));
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#json").click()]);
  const result = JSON.parse(await readFile(await download.path(), "utf8"));
  assert.equal(result.poses.length, 2);
  await shot(page, "find");
  // Another method, whose result has other keys.
  await page.getByLabel("Method").selectOption("mttm");
  await page.locator(".choice", { hasText: "driller" }).click();
  await page.getByRole("button", { name: "Find", exact: true }).click();
  await page.locator("#job-row").waitFor({ state: "visible" });
  await page.locator("#job-row").waitFor({ state: "hidden", timeout: 120000 });
  assert.equal(await page.locator("#status").innerText(), "");
  assert.match(await page.locator("#table").innerText(), /duck|Nothing was found/);
  // Without a camera, the message says what to do.
  await page.goto(`${address}/find?object=duck`);
  await page.locator("#any").setInputFiles(frame);
  await page.getByRole("button", { name: "Find", exact: true }).click();
  await page.locator("#status .problem").waitFor();
  assert.match(await page.locator("#status").innerText(), /camera/);
}

async function grasp(page, address) {
  await page.goto(`${address}/grasp`);
  await page.locator("#any").setInputFiles(files);
  await page.locator("#files li").nth(2).waitFor();
  await page.getByRole("button", { name: "Propose grasps" }).click();
  await page.locator("#table tbody tr").first().waitFor({ timeout: 120000 });
  await page.locator("#overlay").evaluate((image) => image.decode());
  await shot(page, "grasp");
}

/** The mean distance of two poses' images of the object's surroundings, metres: a correction by hand is not exact. */
function apart(a, b) {
  const at = (m, p) => [0, 1, 2].map((i) => m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3]);
  const points = [[0.05, 0, 0], [-0.05, 0, 0], [0, 0.05, 0], [0, -0.05, 0], [0, 0, 0.08]];
  return points.reduce((sum, p) => sum + Math.hypot(...at(a, p).map((v, k) => v - at(b, p)[k])), 0) / points.length;
}

const teachingOf = async (page, address) => {
  const id = new URL(page.url()).searchParams.get("id");
  return (await fetch(`${address}/v1/teachings/${id}`)).json();
};

/** Drags on the editor's canvas, from its middle, by some pixels of the screen. */
async function dragged(page, dx, dy, options = {}) {
  const box = await page.locator("#canvas").boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  if (options.key) await page.keyboard.down(options.key);
  await page.mouse.move(x, y);
  await page.mouse.down({ button: options.button || "left" });
  await page.mouse.move(x + dx, y + dy, { steps: 6 });
  await page.mouse.up({ button: options.button || "left" });
  if (options.key) await page.keyboard.up(options.key);
}

async function opened(page, number) {
  await page.locator("#editor").evaluate((dialog) => delete dialog.dataset.shown);
  await page.locator(`.tile[data-number="${number}"]`).click();
  await page.locator(`#editor[data-shown="${number}"]`).waitFor({ timeout: 30000 });
}

/** Corrects a pose with the mouse: dragged away and back; then away in every other way, and back by points. */
async function poseCorrected(page, address) {
  const pose = async () => (await teachingOf(page, address)).photographs[3].camera_from_board;
  const before = await pose();
  await opened(page, 3);
  const draggedAndSaved = async (dx, dy) => {
    await page.locator("#editor-status").evaluate((status) => status.replaceChildren());
    await dragged(page, dx, dy);
    await page.locator("#pose-save").click();
    await page.getByText("The pose is saved.").waitFor();
    return apart(await pose(), before);
  };
  const away = await draggedAndSaved(36, -22);
  const back = await draggedAndSaved(-36, 22);
  assert(away > 0.005 && back < 0.001, `dragged ${(1000 * away).toFixed(1)} mm away, and back to ${(1000 * back).toFixed(2)} mm`);
  console.log(`teach: a pose that was ${(1000 * away).toFixed(1)} mm off, corrected by the mouse to ${(1000 * back).toFixed(2)} mm`);
  await dragged(page, 40, 25);
  await dragged(page, 60, -20, { button: "right" });
  await dragged(page, 30, 0, { key: "Alt" });
  await page.mouse.wheel(0, 240);
  await page.locator("#canvas").evaluate((canvas) => canvas.focus());
  await shot(page, "teach-pose");
  await page.locator("#editor-status").evaluate((status) => status.replaceChildren());
  await page.locator("#pose-save").click();
  await page.getByText("The pose is saved.").waitFor();
  const moved = (await teachingOf(page, address)).photographs[3];
  assert.equal(moved.pose_by, "person");
  assert(apart(moved.camera_from_board, before) > 0.01, "dragging, rotating and the wheel change the pose");
  await pointsMarked(page, address, before);
}

/** Brings the pose back by four points that are marked in another photograph and in this one. */
async function pointsMarked(page, address, before) {
  await page.locator("#tab-points").click();
  await page.locator("#reference").waitFor();
  await page.waitForTimeout(300);
  const { camera, photographs: all } = await teachingOf(page, address);
  const other = Number(await page.locator("#other").inputValue());
  const from = all.find((p) => p.number === other).camera_from_board;
  const seen = (m, p) => {
    const [x, y, z] = [0, 1, 2].map((i) => m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3]);
    return [(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy];
  };
  const click = async (id, [u, v]) => {
    const box = await page.locator(id).boundingBox();
    const k = box.width / camera.width;
    await page.mouse.click(box.x + (u + 0.5) * k, box.y + (v + 0.5) * k);
  };
  // Points of the board beside the object, which both photographs show.
  const inside = ([u, v]) => u > 8 && v > 8 && u < camera.width - 8 && v < camera.height - 8;
  const around = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => [0.085 * Math.cos(i * Math.PI / 4), 0.085 * Math.sin(i * Math.PI / 4), 0]);
  const good = around.filter((p) => inside(seen(from, p)) && inside(seen(before, p)));
  assert(good.length >= 4, `${good.length} points in both photographs`);
  await page.locator("#editor").evaluate((dialog) => dialog.scrollTo(0, dialog.scrollHeight));
  for (const p of good) {
    await click("#reference", seen(from, p));
    await click("#canvas", seen(before, p));
  }
  await shot(page, "teach-points");
  await page.locator("#points-save").click();
  await page.getByText("The pose is saved: check").waitFor();
  const back = (await teachingOf(page, address)).photographs[3].camera_from_board;
  const far = apart(back, before);
  assert(far < 0.02, `marked points give the pose: ${(1000 * far).toFixed(1)} mm`);
  console.log(`teach: pose by ${good.length} marked points, ${(1000 * far).toFixed(1)} mm from the one before`);
  await page.locator("#editor-close").click();
}

/** Paints in a mask, undoes, takes the mesh's silhouette. */
async function maskCorrected(page, address) {
  await opened(page, 5);
  await page.locator("#tab-mask").click();
  // Pixels of the canvas that differ from what was there at first; once it is read often the browser draws it in another way, not
  // to the last bit.
  const changed = () => page.locator("#canvas").evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    window.first ??= data;
    let count = 0;
    for (let i = 0; i < data.length; i++) if (Math.abs(data[i] - window.first[i]) > 40) count += 1;
    return count;
  });
  await changed();
  await dragged(page, 260, 0);
  const painted = await changed();
  assert(painted > 1000, `the brush adds to the mask: ${painted}`);
  await page.locator("#mask-undo").click();
  const left = await changed();
  assert(left < 0.05 * painted, `a stroke is undone: ${left} of ${painted}`);
  await page.locator("#mask-mesh").click();
  await shot(page, "teach-mask");
  await page.locator("#mask-save").click();
  await page.getByText("The mask is saved.").waitFor();
  assert.equal((await teachingOf(page, address)).photographs[5].mask_by, "person");
  await page.locator("#editor-close").click();
}

async function teach(page, address) {
  await page.goto(`${address}/teach`);
  // Without the name, and with too few photographs, the page says what to do.
  const names = (await readdir(join(photographs, "photographs"))).sort();
  const files = names.map((name) => join(photographs, "photographs", name));
  await page.locator("#any").setInputFiles(files.slice(0, 2));
  await page.getByRole("button", { name: "Teach", exact: true }).click();
  await page.locator("#status .problem").waitFor();
  assert.match(await page.locator("#status").innerText(), /name/);
  await page.getByLabel("Name of the object").fill("taught");
  await page.getByRole("button", { name: "Teach", exact: true }).click();
  await page.getByText("found 2 photographs").waitFor({ timeout: 60000 });
  await page.locator("#any").setInputFiles([...files.slice(2), join(photographs, "camera.json")]);
  await page.getByRole("button", { name: "Add the chosen files" }).click();
  await page.getByText(/Working: finding the object/).waitFor({ timeout: 60000 });
  await page.locator('#state[data-state="taught"]').waitFor({ timeout: 300000 });
  assert.equal(await page.locator(".tile").count(), files.length);
  for (const tile of await page.locator(".tile img").all()) {
    await tile.scrollIntoViewIfNeeded();
    await tile.evaluate((image) => image.decode());
  }
  await page.locator("#viewer canvas").waitFor({ timeout: 30000 });
  await shot(page, "teach");
  await poseCorrected(page, address);
  await maskCorrected(page, address);
  await page.getByRole("button", { name: "Continue" }).click();
  await page.locator('#state[data-state="taught"]').waitFor({ timeout: 300000 });
  await page.getByRole("button", { name: "Accept and store" }).click();
  await page.getByText("taught is stored.").waitFor({ timeout: 120000 });
  await page.getByRole("link", { name: "Find it in an image" }).click();
  await page.locator('input[value="taught"]').waitFor();
  assert(await page.locator('input[value="taught"]').isChecked());
  const scene = ["scene/depth.png", "scene/rgb.jpg", "camera.json"].map((name) => join(photographs, name));
  await page.locator("#any").setInputFiles(scene);
  await page.locator("#files li").nth(2).waitFor();
  await page.getByRole("button", { name: "Find", exact: true }).click();
  await page.locator("#table tbody tr").first().waitFor({ timeout: 120000 });
  const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#json").click()]);
  const [pose] = JSON.parse(await readFile(await download.path(), "utf8")).poses;
  const truth = JSON.parse(await readFile(join(photographs, "truth.json"), "utf8")).scene_camera_from_board;
  // The object stands where the board's origin is, its middle above it.
  const expected = [0, 1, 2].map((i) => truth[i][2] * 0.043 + truth[i][3]);
  const far = Math.hypot(...expected.map((v, i) => v - pose.camera_from_object[i][3]));
  assert(far < 0.015, `found ${(1000 * far).toFixed(1)} mm from where it stands`);
  console.log(`teach: found in another image ${(1000 * far).toFixed(1)} mm from where it stands`);
  await shot(page, "teach-found");
}

/** Starts the training of the taught object, follows it after a reload, and cancels it. */
async function train(page, address) {
  await page.goto(address);
  await page.locator('.object[data-name="duck"]').click();
  await page.locator('#viewer[data-shown="duck"]').waitFor({ timeout: 30000 });
  assert(await page.locator("#training").isHidden(), "an object without photographs is not trained");
  await page.locator('.object[data-name="taught"]').click();
  await page.getByRole("button", { name: "Train a network" }).click();
  await page.locator("#train-status", { hasText: /making views .* \(\d+ of \d+\)/ }).waitFor({ timeout: 60000 });
  await shot(page, "objects-training");
  await page.reload();
  await page.locator('.object[data-name="taught"]').click();
  await page.locator("#train-status", { hasText: /\d+ of \d+/ }).waitFor({ timeout: 60000 });
  await page.locator("#training").getByRole("button", { name: "Cancel" }).click();
  await page.locator("#train-status .problem").waitFor({ timeout: 60000 });
  assert.match(await page.locator("#train-status").innerText(), /Cancelled/);
  await page.getByRole("button", { name: "Train a network" }).waitFor();
  assert(await page.locator("#train-bar").isHidden());
}

const LENGTH = 0.2;

/** The pixels at which a photograph on the cloth shows the two ends of the length. */
async function trueEnds(number) {
  const read = async (name) => JSON.parse(await readFile(join(cloth, name), "utf8"));
  const [camera, truth] = [await read("camera.json"), await read("truth.json")];
  const pose = truth.camera_from_board[number];
  const seen = (p) => {
    const [x, y, z] = [0, 1, 2].map((i) => pose[i][0] * p[0] + pose[i][1] * p[1] + pose[i][2] * p[2] + pose[i][3]);
    return [(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy];
  };
  return { width: camera.width, ends: [seen([-0.08, -0.06, 0]), seen([0.08, 0.06, 0])] };
}

/** Marks the ends of a length in three photographs: a mark is moved, one removed, one set while zoomed in, one left out. */
async function endsMarked(page) {
  const numbers = [0, 5, 8];
  const [first, second, third] = await Promise.all(numbers.map(trueEnds));
  const place = async ({ width }, [u, v]) => {
    const box = await page.locator("#canvas").boundingBox();
    const k = box.width / width;
    return [box.x + (u + 0.5) * k, box.y + (v + 0.5) * k];
  };
  const click = async (photograph, pixel) => page.mouse.click(...(await place(photograph, pixel)));
  await page.getByRole("button", { name: "Mark the ends" }).click();
  await page.locator('#editor[data-shown="0"]').waitFor();
  // Somewhere else first, then moved to where it is.
  const beside = first.ends[0].map((v) => v + 40);
  await click(first, beside);
  await page.mouse.move(...(await place(first, beside)));
  await page.mouse.down();
  await page.mouse.move(...(await place(first, first.ends[0])), { steps: 5 });
  await page.mouse.up();
  // The other end is chosen by itself; a wrong mark is removed.
  await click(first, first.ends[1].map((v) => v - 50));
  await page.locator('#ends button[data-end="1"][aria-pressed="true"]').waitFor();
  await page.getByRole("button", { name: "Remove the mark" }).click();
  assert(await page.locator("#end-remove").isDisabled(), "there is no mark any more");
  await click(first, first.ends[1]);
  await shot(page, "teach-ends");
  await page.locator("#editor-close").click();
  // Zoomed in, the photograph is shown larger around the pointer, which stays on its pixel.
  await opened(page, numbers[1]);
  const at = await place(second, second.ends[0]);
  await page.mouse.move(...at);
  await page.mouse.wheel(0, -600);
  await page.waitForTimeout(200);
  await page.mouse.click(...at);
  await page.getByRole("button", { name: "Zoom out" }).click();
  await page.getByRole("button", { name: "Zoom out" }).click();
  await click(second, second.ends[1]);
  // The third one by the buttons; it has the first end only.
  for (let i = numbers[1]; i < numbers[2]; i++) {
    await page.locator("#ends-next").click();
    await page.locator(`#editor[data-shown="${i + 1}"]`).waitFor();
  }
  await click(third, third.ends[0]);
  await page.locator("#editor-close").click();
  return [first.ends, second.ends, [third.ends[0], null]];
}

async function teachWithoutBoard(page, address) {
  await page.goto(`${address}/teach`);
  const names = (await readdir(join(cloth, "photographs"))).sort();
  const files = names.map((name) => join(cloth, "photographs", name));
  await page.locator("#any").setInputFiles([...files, join(cloth, "camera.json")]);
  await page.getByLabel("without a board").check();
  await page.getByLabel("Name of the object").fill("cloth");
  await page.getByText("Ruler, depth and mesh").click();
  assert(await page.locator("#ruler-row").isHidden(), "there is no ruler without the board");
  await page.getByLabel("Do not search for hollows").check();
  await shot(page, "teach-without-board-form");
  await page.getByRole("button", { name: "Teach", exact: true }).click();
  await page.getByText("The photographs are stored.").waitFor({ timeout: 60000 });
  assert(await page.locator("#run").isDisabled(), "without the scale nothing can begin");
  // A length alone is refused with what is missing.
  await page.getByLabel("Length, millimetres").fill("200");
  await page.getByRole("button", { name: "Begin" }).click();
  await page.locator("#status .problem").waitFor();
  assert.match(await page.locator("#status").innerText(), /ends: found nothing/);
  const truth = await endsMarked(page);
  const marked = "End 1 is marked in 3 photographs, end 2 in 2 photographs.";
  assert.equal(await page.locator("#marked").innerText(), marked);
  assert.match(await page.locator('.tile[data-number="8"]').innerText(), /end 1 marked/);
  // Marks that are not saved yet outlive a reload.
  await page.reload();
  await page.getByText(marked).waitFor();
  await page.getByLabel("Length, millimetres").fill("200");
  await page.getByRole("button", { name: "Save length and ends" }).click();
  await page.getByText("Length and ends are saved.").waitFor();
  const saved = await teachingOf(page, address);
  assert.equal(saved.length, LENGTH);
  assert.deepEqual(saved.ends.map((e) => e.photograph), [0, 5, 8]);
  saved.ends.forEach(({ points }, i) => points.forEach((point, end) => {
    const expected = truth[i][end];
    if (!expected) return assert.equal(point, null);
    const far = Math.hypot(point[0] - expected[0], point[1] - expected[1]);
    // The browser reports the pointer in whole pixels of the screen.
    return assert(far < 1.5, `end ${end + 1} of mark ${i}: ${far.toFixed(2)} pixels from where it is`);
  }));
  await shot(page, "teach-scale");
  await page.getByRole("button", { name: "Begin" }).click();
  await page.getByText(/Working: finding poses/).waitFor({ timeout: 60000 });
  await page.locator('#state[data-state="taught"]').waitFor({ timeout: 600000 });
  const { mesh, rms } = await teachingOf(page, address);
  const ratio = mesh.diameter / 0.109;
  assert(Math.abs(ratio - 1) < 0.06 && rms < 2, `diameter ${mesh.diameter} m, features ${rms} pixels off`);
  console.log(`teach: without a board the diameter is ${(100 * (ratio - 1)).toFixed(1)} % off`);
  await shot(page, "teach-without-board");
  // The mesh itself, which cannot be combined with that setting.
  await page.getByText("Ruler, depth and mesh").click();
  await page.locator("#mesh-file").setInputFiles(join(demo, "models/obj_000009.ply"));
  await page.getByLabel("Unit of the mesh").selectOption("mm");
  await page.getByRole("button", { name: "Add the chosen files" }).click();
  await page.locator("#status .problem").waitFor();
  assert.match(await page.locator("#status").innerText(), /hull_only/);
  await page.getByLabel("Do not search for hollows").uncheck();
  await page.getByRole("button", { name: "Add the chosen files" }).click();
  await page.getByText(/Working: making the mesh/).waitFor({ timeout: 60000 });
  await page.locator('#state[data-state="taught"]').waitFor({ timeout: 600000 });
  const given = await teachingOf(page, address);
  assert(given.given_mesh && Math.abs(given.mesh.diameter - 0.1089) < 0.001, `a mesh of ${given.mesh.diameter} m`);
  await shot(page, "teach-mesh");
  await page.getByLabel("Forget the given mesh").check();
  await page.getByRole("button", { name: "Apply the settings" }).waitFor();
}

const folder = await mkdtemp(join(tmpdir(), "sixfold-pages-"));
await mkdir(out, { recursive: true });
let server, browser;
try {
  const started = await serve(folder);
  server = started.server;
  server.removeAllListeners("exit");
  browser = await chromium.launch({
    executablePath: browserPath,
    args: [
      "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
      "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    ],
  });
  const page = await browser.newPage({ viewport: SIZES.wide, acceptDownloads: true });
  const faults = [];
  page.on("pageerror", (error) => faults.push(String(error)));
  page.on("console", (message) => {
    // A refused request is shown on the page; everything else is a fault.
    if (message.type() === "error" && !/status of 4\d\d/.test(message.text())) faults.push(message.text());
  });
  page.on("request", (request) => {
    const url = request.url();
    if (!url.startsWith(started.address) && !/^(blob|data):/.test(url)) faults.push(`asked for ${url}`);
  });
  page.setDefaultTimeout(30000);
  const pages = { objects, find, grasp, teach, train, teachWithoutBoard };
  const wanted = (process.env.PAGES || Object.keys(pages).join()).split(",");
  for (const name of wanted) await pages[name](page, started.address);
  assert.deepEqual(faults, []);
  console.log(`pages: ${wanted.join(", ")} work at both sizes`);
} finally {
  await browser?.close();
  server?.kill("SIGINT");
  await new Promise((resolve) => (server ? server.once("exit", resolve) : resolve()));
  await rm(folder, { recursive: true, force: true });
}
