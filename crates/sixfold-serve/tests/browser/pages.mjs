// Drives the pages of `sixfold serve` in a real browser, as a user would: adds an object, turns it, finds it in the demo's frame,
// downloads the result, proposes grasps; at a wide and a narrow size, with an image of each page.
//
//   npm install                                       (in this folder or a copy of it)
//   node pages.mjs SIXFOLD DEMO OUT [CHROMIUM]        the program, the folder data/demo, a folder for images
//
// Exits with 1 and a message at the first thing that is not as it should be.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { mkdtemp, mkdir, readFile, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium } from "playwright-core";

const [program, demo, out, browserPath = "/usr/bin/chromium"] = process.argv.slice(2);
assert(program && demo && out, "usage: node pages.mjs SIXFOLD DEMO OUT [CHROMIUM]");

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
  await page.locator("#table tbody tr").nth(1).waitFor({ timeout: 120000 });
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
  await objects(page, started.address);
  await find(page, started.address);
  await grasp(page, started.address);
  assert.deepEqual(faults, []);
  console.log("pages: objects, find, grasp work at both sizes");
} finally {
  await browser?.close();
  server?.kill("SIGINT");
  await new Promise((resolve) => (server ? server.once("exit", resolve) : resolve()));
  await rm(folder, { recursive: true, force: true });
}
