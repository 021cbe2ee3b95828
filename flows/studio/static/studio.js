// The studio page: uploads, correction of cut-outs, conversions and their progress. All state is on the server.
const ROOT = "/dg4d/studio";
const SECRET = "prefect-password"; // where the sign-in page and Prefect's own pages keep the secret
const POLL_MS = 1500;
const find = (selector, within = document) => within.querySelector(selector);
const all = (selector, within = document) => [...within.querySelectorAll(selector)];
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

// ---- messages and requests

function complain(text) {
  const box = find("#message");
  box.textContent = text;
  box.hidden = !text;
  if (text) box.scrollIntoView({ block: "nearest" });
}

function say(text) {
  find("#status").textContent = text;
}

function signInAgain() {
  location.assign(`/dg4d/login?next=${encodeURIComponent(location.pathname + location.search)}`);
}

// The answer as JSON; throws an Error with the server's sentence.
async function answerOf(response) {
  if (response.status === 401) signInAgain();
  const content = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(content.detail ?? `The server answered ${response.status}.`);
  return content;
}

const signature = () => ({ Authorization: `Basic ${localStorage.getItem(SECRET) ?? ""}` });
let token = { until: 0, headers: {} };

// Headers of a change: the secret, and Prefect's token against forged requests.
async function permission() {
  if (token.until < Date.now()) {
    const client = [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    const given = await answerOf(await fetch(`/api/csrf-token?client=${client}`, { headers: signature() }));
    const headers = { "Prefect-Csrf-Token": given.token, "Prefect-Csrf-Client": client };
    token = { until: Math.min(Date.parse(given.expiration) - 60_000, Date.now() + 1_800_000), headers };
  }
  return { ...signature(), ...token.headers };
}

async function post(path, body = {}) {
  const raw = body instanceof Blob;
  try {
    const headers = { ...(await permission()), "Content-Type": raw ? "application/octet-stream" : "application/json" };
    return await answerOf(await fetch(path, { method: "POST", headers, body: raw ? body : JSON.stringify(body) }));
  } catch (error) {
    if (!(error instanceof TypeError)) throw error;
    throw new Error("The server does not answer. It may be starting again; nothing is lost.");
  }
}

async function read(path, headers = {}) {
  const response = await fetch(path, { headers });
  if (response.status === 401) signInAgain();
  if (!response.ok) throw new Error(`The server answered ${response.status}.`);
  return response;
}

// Runs `work` with a disabled button; shows its error.
async function attempt(work, button = null) {
  complain("");
  if (button) button.disabled = true;
  try {
    return await work();
  } catch (error) {
    complain(error.message);
    return null;
  } finally {
    if (button) button.disabled = false;
  }
}

document.addEventListener("click", (event) => {
  const button = event.target.closest?.("button[data-post], button[data-again]");
  if (!button) return;
  const path = button.dataset.post ?? `${ROOT}/assets/${find("#asset").dataset.asset}/again`;
  attempt(async () => {
    const answer = await post(path, button.dataset.again ? JSON.parse(button.dataset.again) : {});
    if (button.dataset.again || "follow" in button.dataset) location.assign(answer.address);
    else say("Request sent.");
  }, button);
});

// ---- front page

// Sends one file with its progress; fetch does not report that of uploads.
async function send(path, file, onProgress) {
  const headers = await permission();
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", path);
    for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
    request.upload.onprogress = (event) => onProgress(event.loaded);
    request.onerror = () => reject(new Error("The upload was cut off; drop the files again."));
    request.onload = () => {
      if (request.status === 401) signInAgain();
      const content = (() => { try { return JSON.parse(request.responseText); } catch { return {}; } })();
      if (request.status < 300) resolve(content);
      else reject(new Error(content.detail ?? `The server answered ${request.status}.`));
    };
    request.send(file);
  });
}

// All files of dropped folders, with those dropped as they are.
async function filesOf(items) {
  const entries = [...items].map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile?.()).filter(Boolean);
  const found = [];
  let folders = 0;
  const walk = async (entry) => {
    if (entry instanceof File) return void found.push(entry);
    if (entry.isFile) return void found.push(await new Promise((resolve, reject) => entry.file(resolve, reject)));
    folders += 1;
    const reader = entry.createReader();
    for (;;) {
      const part = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
      if (!part.length) return undefined;
      for (const child of part) await walk(child);
    }
  };
  for (const entry of entries) await walk(entry);
  return { files: found.filter((file) => !file.name.startsWith(".")), folders };
}

// What several files are: one subject, or a subject each; empty if the user cancels.
function askSeveral() {
  const dialog = find("#several");
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue), { once: true }));
}

async function upload(files, isFolder) {
  if (!files.length) return;
  const models = files.some((file) => /\.(glb|gltf|obj|usdz|ply|spz)$/i.test(file.name));
  const purpose = isFolder ? "batch" : files.length > 1 && !models ? await askSeveral() : "views";
  if (!purpose) return;
  const [box, bar, text] = ["#uploads", "#upload-bar", "#upload-text"].map((name) => find(name));
  box.hidden = false;
  const refused = [];
  await attempt(async () => {
    const draft = await post(`${ROOT}/drafts`);
    const total = files.reduce((sum, file) => sum + file.size, 0) || 1;
    let done = 0;
    let kept = 0;
    for (const [number, file] of files.entries()) {
      text.textContent = `Uploading ${file.name} (${number + 1} of ${files.length})`;
      const path = `${ROOT}/drafts/${draft.id}/files?name=${encodeURIComponent(file.name || "pasted.png")}`;
      try {
        await send(path, file, (loaded) => { bar.value = (done + loaded) / total; });
        kept += 1;
      } catch (error) {
        refused.push(error.message);
        if (files.length === 1) throw error;
      }
      done += file.size;
    }
    if (!kept) throw new Error(refused[0]);
    if (purpose === "batch") {
      const started = await post(`${ROOT}/drafts/${draft.id}/runs`, { batch: true });
      location.assign(started.address);
    } else location.assign(draft.address);
  });
  box.hidden = true;
}

function startFront() {
  const drop = find("#drop");
  for (const [id, isFolder] of [["#files", false], ["#folder", true]]) {
    find(id).addEventListener("change", (event) => {
      const files = [...event.target.files].filter((file) => !file.name.startsWith("."));
      event.target.value = "";
      upload(files, isFolder);
    });
  }
  document.addEventListener("dragover", (event) => { event.preventDefault(); drop.classList.add("over"); });
  document.addEventListener("dragleave", (event) => { if (!event.relatedTarget) drop.classList.remove("over"); });
  document.addEventListener("drop", async (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    const { files, folders } = await filesOf(event.dataTransfer.items);
    upload(files, folders > 0);
  });
  document.addEventListener("paste", (event) => {
    const files = [...(event.clipboardData?.files ?? [])];
    if (files.length) upload(files, false);
  });
  const filters = find("#filters");
  let waiting = 0;
  const refresh = async () => {
    const query = new URLSearchParams([...new FormData(filters)].filter(([, value]) => value));
    history.replaceState(null, "", `${ROOT}${query.size ? `?${query}` : ""}`);
    const asked = (waiting += 1);
    const page = await read(`${ROOT}?${query}`, { "X-Fragment": "cards" }).then((answer) => answer.text());
    if (asked === waiting) find("#cards").innerHTML = page;
  };
  filters.addEventListener("submit", (event) => { event.preventDefault(); refresh(); });
  filters.addEventListener("input", () => attempt(refresh));
  watchActivity();
}

async function watchActivity() {
  const place = find("#activity");
  let before = place.innerHTML.trim();
  for (;;) {
    await pause(2 * POLL_MS);
    if (document.hidden) continue;
    try {
      const now = (await read(`${ROOT}/activity`).then((answer) => answer.text())).trim();
      if (now !== before && !place.contains(document.activeElement)) place.innerHTML = before = now;
    } catch { /* the server restarts; the next look succeeds */ }
  }
}

// ---- draft: correction of the cut-out, motions, conversion

const load = (address) => new Promise((resolve, reject) => {
  const image = new Image();
  image.onload = () => resolve(image);
  image.onerror = () => reject(new Error("The picture could not be loaded."));
  image.src = address;
});

class Editor {
  constructor(element) {
    this.path = `${ROOT}/drafts/${element.dataset.draft}`;
    this.kind = element.dataset.kind;
    this.canvas = find("#stage");
    this.box = [];
    this.strokes = [];
    this.matte = document.createElement("canvas"); // its alpha is the matte
    this.asked = 0;
    this.cursor = null;
    if (this.canvas) this.listen();
  }

  get tool() { return find("input[name=tool]:checked").value; }
  get masked() { return this.strokes.length > 0; }
  get brush() { return Number(find("#brush").value) * this.canvas.width / 768; }

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.begin(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", () => this.end());
    canvas.addEventListener("pointercancel", () => { this.drag = null; this.draw(); });
    canvas.addEventListener("pointerleave", () => { if (!this.drag) { this.cursor = null; this.draw(); } });
    canvas.addEventListener("keydown", (event) => this.key(event));
    find("#undo").addEventListener("click", () => { this.strokes.pop(); this.changed(); });
    find("#reset").addEventListener("click", () => { this.strokes = []; this.box = []; this.cut(); });
    find("#whole").addEventListener("change", () => this.draw());
    find("#apply-box").addEventListener("click", () => {
      const values = all("[data-box]").map((input) => Math.round(Number(input.value)));
      this.box = values[2] > 0 && values[3] > 0 ? values : [];
      this.cut();
    });
    all("input[name=tool]").forEach((input) => input.addEventListener("change", () => this.draw()));
  }

  // Asks for the cut-out within the box and shows it.
  async cut() {
    const asked = (this.asked += 1);
    find("#stage-wait").hidden = false;
    await attempt(async () => {
      const facts = await post(`${this.path}/cutout`, { box: this.box });
      const [picture, matte] = await Promise.all([load(facts.picture), load(facts.matte)]);
      if (asked !== this.asked) return;
      this.show(facts, picture, matte);
      await this.films();
    });
    if (asked === this.asked) find("#stage-wait").hidden = true;
  }

  show(facts, picture, matte) {
    [this.facts, this.picture] = [facts, picture];
    [this.canvas.width, this.canvas.height] = [picture.naturalWidth, picture.naturalHeight];
    this.base = document.createElement("canvas");
    [this.base.width, this.base.height] = [picture.naturalWidth, picture.naturalHeight];
    const context = this.base.getContext("2d");
    context.drawImage(matte, 0, 0, this.base.width, this.base.height);
    const pixels = context.getImageData(0, 0, this.base.width, this.base.height);
    for (let at = 0; at < pixels.data.length; at += 4) {
      pixels.data[at + 3] = pixels.data[at];
      pixels.data[at] = pixels.data[at + 1] = pixels.data[at + 2] = 255;
    }
    context.putImageData(pixels, 0, 0);
    find("#facts").textContent = `${facts.width} × ${facts.height}${facts.frames > 1 ? `, ${facts.frames} frames` : ""}`;
    find("#notes").textContent = facts.problem || facts.notes.join(" ");
    all("[data-box]").forEach((input, index) => {
      input.value = this.box[index] ?? [0, 0, facts.width, facts.height][index];
    });
    find("#stage-wait").hidden = true;
    this.changed(false);
  }

  changed(films = true) {
    find("#undo").disabled = !this.strokes.length;
    this.paintMatte();
    this.draw();
    if (films) {
      clearTimeout(this.later);
      this.later = setTimeout(() => this.films(), 1200);
    }
  }

  paintMatte() {
    [this.matte.width, this.matte.height] = [this.base.width, this.base.height];
    const context = this.matte.getContext("2d");
    context.drawImage(this.base, 0, 0);
    for (const stroke of this.strokes) this.paintStroke(context, stroke);
  }

  paintStroke(context, { tool, size, points }) {
    context.globalCompositeOperation = tool === "keep" ? "source-over" : "destination-out";
    [context.strokeStyle, context.lineWidth, context.lineCap, context.lineJoin] = ["#fff", size, "round", "round"];
    context.beginPath();
    context.moveTo(...points[0]);
    for (const point of points) context.lineTo(point[0] + 0.01, point[1]);
    context.stroke();
    context.globalCompositeOperation = "source-over";
  }

  draw() {
    if (!this.picture) return;
    const { canvas } = this;
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.globalAlpha = find("#whole").checked ? 0.75 : 0.16;
    context.drawImage(this.picture, 0, 0);
    context.globalAlpha = 1;
    const cut = document.createElement("canvas");
    [cut.width, cut.height] = [canvas.width, canvas.height];
    const inside = cut.getContext("2d");
    inside.drawImage(this.picture, 0, 0);
    inside.globalCompositeOperation = "destination-in";
    inside.drawImage(this.matte, 0, 0);
    context.drawImage(cut, 0, 0);
    this.drawMarks(context);
  }

  drawMarks(context) {
    const unit = this.canvas.width / 768;
    const scale = this.canvas.width / this.facts.width;
    const frame = this.drag?.tool === "box" ? this.drag.frame : this.box.map((value) => value * scale);
    if (frame?.length === 4) {
      [context.lineWidth, context.strokeStyle] = [3 * unit, "#fff"];
      context.strokeRect(...frame);
      [context.lineWidth, context.strokeStyle] = [1.5 * unit, "#6d4dff"];
      context.strokeRect(...frame);
    }
    if (this.cursor && this.tool !== "box") {
      context.beginPath();
      context.arc(...this.cursor, this.brush / 2, 0, 2 * Math.PI);
      [context.lineWidth, context.strokeStyle] = [3 * unit, "#fff"];
      context.stroke();
      [context.lineWidth, context.strokeStyle] = [1.5 * unit, this.tool === "keep" ? "#0a8f6a" : "#d0342c"];
      context.stroke();
    }
  }

  place(event) {
    const at = this.canvas.getBoundingClientRect();
    return [(event.clientX - at.left) * this.canvas.width / at.width, (event.clientY - at.top) * this.canvas.height / at.height];
  }

  begin(event) {
    if (!this.picture || event.button) return;
    event.preventDefault();
    this.canvas.setPointerCapture(event.pointerId);
    const point = this.place(event);
    this.drag = { tool: this.tool, start: point };
    if (this.tool !== "box") this.strokes.push({ tool: this.tool, size: this.brush, points: [point] });
    this.move(event);
  }

  move(event) {
    this.cursor = this.place(event);
    if (this.drag?.tool === "box") {
      const [x, y] = this.drag.start;
      const [u, v] = [Math.min(Math.max(this.cursor[0], 0), this.canvas.width), Math.min(Math.max(this.cursor[1], 0), this.canvas.height)];
      this.drag.frame = [Math.min(x, u), Math.min(y, v), Math.abs(u - x), Math.abs(v - y)];
    } else if (this.drag) {
      this.strokes.at(-1).points.push(this.cursor);
      this.paintMatte();
    }
    this.draw();
  }

  end() {
    const drag = this.drag;
    this.drag = null;
    if (drag?.tool === "box" && drag.frame?.[2] > 8 && drag.frame[3] > 8) {
      const scale = this.facts.width / this.canvas.width;
      const [x, y, width, height] = drag.frame.map((value) => Math.round(value * scale));
      this.box = [x, y, Math.min(width, this.facts.width - x), Math.min(height, this.facts.height - y)];
      this.cut();
    } else if (drag && drag.tool !== "box") this.changed();
    else this.draw();
  }

  // Arrow keys move the brush, the space bar paints a dot.
  key(event) {
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (!this.picture || this.tool === "box" || !(event.key in moves || event.key === " ")) return;
    event.preventDefault();
    const [x, y] = this.cursor ?? [this.canvas.width / 2, this.canvas.height / 2];
    const [dx, dy] = moves[event.key] ?? [0, 0];
    const step = Math.max(this.brush / 2, 2);
    this.cursor = [Math.min(Math.max(x + dx * step, 0), this.canvas.width), Math.min(Math.max(y + dy * step, 0), this.canvas.height)];
    if (event.key !== " ") return void this.draw();
    this.strokes.push({ tool: this.tool, size: this.brush, points: [this.cursor] });
    this.changed();
  }

  // Sends the matte as a gray picture, if it was painted.
  async sendMask() {
    if (!this.masked) return;
    const drawn = document.createElement("canvas");
    [drawn.width, drawn.height] = [this.matte.width, this.matte.height];
    const context = drawn.getContext("2d");
    context.fillRect(0, 0, drawn.width, drawn.height);
    context.drawImage(this.matte, 0, 0);
    await post(`${this.path}/mask`, await new Promise((resolve) => drawn.toBlob(resolve, "image/png")));
  }

  async films() {
    const text = find("#films-text");
    if (!text || this.kind !== "picture") return;
    const asked = (this.filmsAsked = (this.filmsAsked ?? 0) + 1);
    text.textContent = "Rendering the preview clips …";
    try {
      await this.sendMask();
      const profile = find("[name=profile]").value;
      const { films } = await post(`${this.path}/motions`, { box: this.box, masked: this.masked, profile });
      if (asked !== this.filmsAsked) return;
      for (const film of films) {
        const video = find(`video[data-motion="${film.motion}"]`);
        if (!video) continue;
        video.src = film.address;
        if (!matchMedia("(prefers-reduced-motion: reduce)").matches) video.play().catch(() => {});
      }
      text.textContent = films.length ? "" : "The motion comes from the file, or from the model of this profile.";
    } catch (error) {
      if (asked === this.filmsAsked) text.textContent = `The clips could not be rendered: ${error.message}`;
    }
  }

  async convert(form) {
    const values = new FormData(form);
    await this.sendMask();
    const views = all("[data-view]").filter((select) => select.value)
      .map((select) => ({ file: select.dataset.view, azimuth: Number(select.value) }));
    const batch = values.has("batch");
    const wanted = {
      name: batch ? "" : values.get("name"),
      profile: values.get("profile"),
      seed: Number(values.get("seed") || 0),
      commercial_only: values.has("commercial_only"),
      settings: values.get("settings").split("\n").map((line) => line.trim()).filter(Boolean),
      batch,
    };
    if (values.get("motion")) wanted.motion = values.get("motion");
    if (!batch) Object.assign(wanted, { box: this.box, masked: this.masked, views });
    const started = await post(`${this.path}/runs`, wanted);
    location.assign(started.address);
  }
}

function startDraft() {
  const editor = new Editor(find("#draft"));
  find("#convert").addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(() => editor.convert(event.target), find("#go"));
  });
  find("[name=profile]").addEventListener("change", () => editor.films());
  if (editor.canvas) editor.cut();
  else if (find("#films-text")) find("#films-text").textContent = "";
}

// ---- progress of one conversion

const losses = [];

function showStep(list, step) {
  const item = find(`[data-step="${step.name}"]`, list);
  if (!item) return;
  item.className = step.state;
  const figures = Object.entries(step.figures).slice(0, 2).map(([name, value]) => `${name} ${value}`).join(", ");
  const text = step.state === "done" ? (step.seconds === null ? "done" : `${step.seconds} s`) : step.state === "running" ? figures || "running" : step.state;
  find(".step-state", item).textContent = text;
  find("progress", item).value = step.fraction;
}

function showLoss(steps) {
  const fit = steps.find((step) => step.state === "running" && "loss" in step.figures);
  if (!fit) return;
  if (losses.at(-1)?.step !== fit.name) losses.length = 0;
  if (losses.at(-1)?.x !== fit.fraction) losses.push({ step: fit.name, x: fit.fraction, y: fit.figures.loss });
  find("#loss").textContent = fit.figures.loss.toPrecision(4);
  const logs = losses.map(({ y }) => Math.log(Math.max(y, 1e-9)));
  const [low, high] = [Math.min(...logs), Math.max(...logs)];
  const points = losses.map(({ x }, index) => `${(300 * x).toFixed(1)},${(74 - 68 * (logs[index] - low) / (high - low || 1)).toFixed(1)}`);
  find("#chart polyline").setAttribute("points", points.join(" "));
}

function showItems(list, items) {
  list.replaceChildren(...items.map(([name, state]) => {
    const row = document.createElement("li");
    row.className = state;
    for (const [kind, text] of [["tick", ""], ["step-title", name], ["step-state hint", state]]) {
      row.append(Object.assign(document.createElement("span"), { className: kind, textContent: text }));
    }
    return row;
  }));
}

function showRun(run) {
  const list = find("#steps");
  const badge = find("#state");
  if (badge.textContent !== run.state) say(`${run.name}: ${run.state}`);
  [badge.textContent, badge.className] = [run.state, `badge ${run.state}`];
  document.title = `${run.name}: ${run.state} · dg4d studio`;
  find("#left").textContent = run.left;
  [find("#reason").textContent, find("#reason").hidden] = [run.message, !run.message];
  if (run.is_batch) showItems(list, run.items);
  else if (run.steps.some((step) => !find(`[data-step="${step.name}"]`, list)) && run.steps.length) location.reload();
  run.steps.forEach((step) => showStep(list, step));
  const parts = run.is_batch ? run.items.map(([, state]) => Number(state === "done")) : run.steps.map((step) => step.fraction);
  find("#whole").value = run.state === "done" ? 1 : parts.reduce((sum, part) => sum + part, 0) / (parts.length || 1);
  showLoss(run.steps);
  const fit = find("#fit");
  if (run.picture && fit.getAttribute("src") !== run.picture) {
    fit.src = run.picture;
    [fit.hidden, find("#no-fit").hidden] = [false, true];
  }
  if (run.first_look) [find("#look a").href, find("#look").hidden] = [run.first_look, false];
  find("#cancel").hidden = run.has_ended || run.state === "cancelling";
  find("#retry").hidden = !["failed", "cancelled"].includes(run.state);
  find("#open").hidden = run.state !== "done";
  if (run.asset) find("#open").href = run.asset;
}

async function startRun() {
  const path = `${ROOT}/runs/${find("#run").dataset.run}/status`;
  for (;;) {
    try {
      const run = await read(path).then((answer) => answer.json());
      complain("");
      showRun(run);
      if (run.has_ended) return;
    } catch {
      complain("The server does not answer. It may be starting again; nothing is lost.");
    }
    await pause(document.hidden ? 4 * POLL_MS : POLL_MS);
  }
}

({ front: startFront, draft: startDraft, run: startRun })[document.body.dataset.page]?.();
