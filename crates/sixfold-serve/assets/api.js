// What all pages share: requests to the API, problems as people read them, jobs until they end.

/** A problem that the server reported, with its parts. */
export class Problem extends Error {
  constructor(body, status) {
    super(body.error || `the server answered ${status}`);
    Object.assign(this, { status, field: body.field, advice: body.advice });
  }
}

async function problemOf(response) {
  let body = {};
  try {
    body = await response.json();
  } catch {
    // Not one of ours: a proxy's, say.
  }
  return new Problem(body, response.status);
}

/** Asks the API. Where the server wants its token, the user is asked for it once. */
export async function ask(path, options = {}) {
  let response;
  try {
    response = await fetch(path, options);
  } catch {
    throw new Problem({ error: "The server does not answer.", advice: "Is sixfold serve still running?" }, 0);
  }
  if (response.status === 401) {
    await askForToken();
    return ask(path, options);
  }
  if (!response.ok) throw await problemOf(response);
  return response;
}

export async function json(path, options) {
  const response = await ask(path, options);
  return response.status === 204 ? null : response.json();
}

function askForToken() {
  const dialog = element("dialog");
  const input = element("input", { type: "password", autocomplete: "current-password", required: true });
  const wrong = element("p", { className: "status" });
  const form = element("form", {}, [
    element("h2", {}, ["This server needs its token"]),
    element("label", {}, ["The token with which it was started", input]),
    wrong,
    element("button", { className: "primary" }, ["Continue"]),
  ]);
  dialog.append(form);
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("cancel", (event) => event.preventDefault());
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const body = JSON.stringify({ token: input.value });
      const response = await fetch("/v1/session", { method: "POST", body });
      if (!response.ok) {
        wrong.textContent = "Wrong token.";
        return;
      }
      dialog.remove();
      resolve();
    });
  });
}

/** A new element with properties and children. */
export function element(tag, properties = {}, children = []) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-")) made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
}

export const byId = (id) => document.getElementById(id);

/** Shows a problem in a place, with what to do. */
export function showProblem(place, problem) {
  const advice = problem.advice && !problem.message.includes(problem.advice) ? problem.advice : "";
  const children = [problem.message];
  if (advice) children.push(element("p", {}, [advice]));
  place.replaceChildren(element("div", { className: "problem", role: "alert" }, children));
}

/** Follows a job by its events until it ends; `changed` is called with each state. Returns the job as it ended. */
export function follow(job, changed) {
  return new Promise((resolve, reject) => {
    changed(job);
    const events = new EventSource(job.links.events);
    events.addEventListener("job", (event) => {
      const now = JSON.parse(event.data);
      changed(now);
      if (!["queued", "running"].includes(now.state)) {
        events.close();
        resolve(now);
      }
    });
    events.addEventListener("error", () => {
      // It reconnects by itself, also when the server was started again; a job that is gone ends it.
      if (events.readyState === EventSource.CLOSED) {
        reject(new Problem({ error: "The server no longer reports this job.", advice: "Send it again." }, 0));
      }
    });
  });
}

/** Sends a form that becomes a job, follows it, and returns the job and its result. */
export async function run(path, form, changed) {
  const job = await json(path, { method: "POST", body: form });
  const ended = await follow(job, changed);
  if (ended.state === "cancelled") throw new Problem({ error: "Cancelled." }, 409);
  if (ended.state === "failed") throw new Problem(ended.error || {}, 422);
  return { job: ended, result: await json(ended.links.result) };
}
