"use strict";
// Shows what the coordinator tells. Nothing is changed by it, and text from others stays text.

const $ = (id) => document.getElementById(id);
const stage = $("stage"), picture = $("picture"), coarse = $("coarse"), marks = $("marks");
const state = {
  token: null, chosen: null, job: null, seen: null, call: null,
  picture: null, done: null, workers: new Map(), work: [], jobs: [], rays: [],
  zoom: 1, x: 0, y: 0, fits: true, cursor: null, asked: 0,
};

// The token comes in the fragment, which is sent to nobody, and leaves the address bar and the history.
function readFragment() {
  const words = new URLSearchParams(location.hash.slice(1));
  if (words.get("token")) {
    state.token = words.get("token");
    sessionStorage.setItem("rtfarm-token", state.token);
    words.delete("token");
    history.replaceState(null, "", words.size ? `#${words}` : location.pathname);
  }
  state.token ??= sessionStorage.getItem("rtfarm-token");
  state.chosen = words.get("job");
}

function headers(more) {
  return state.token ? { authorization: `Bearer ${state.token}`, ...more } : more;
}

function link(kind, text) {
  $("link").className = kind;
  $("link").textContent = text;
}

// Follows one picture until another is wanted; comes again after what was lost.
async function follow() {
  let pause = 500;
  for (;;) {
    const job = state.job;
    state.call = new AbortController();
    try {
      const more = state.seen ? { "last-event-id": state.seen } : {};
      const query = job ? `?job=${job}` : "";
      const answer = await fetch(`/page/events${query}`, { headers: headers(more), signal: state.call.signal });
      if (answer.status === 401 || answer.status === 403) {
        link("lost", "a token is asked for");
        await askForToken();
        continue;
      }
      if (answer.status === 404) {
        // The farm has forgotten the picture.
        Object.assign(state, { chosen: null, job: null, seen: null });
        continue;
      }
      if (!answer.ok) throw new Error(answer.statusText);
      link("live", "live");
      pause = 500;
      await read(answer.body, job);
    } catch (error) {
      if (error.name === "AbortError") continue;
    }
    link("lost", $("bar").value === 1 ? "the coordinator has gone" : "no connection; trying again");
    await new Promise((resolve) => setTimeout(resolve, pause));
    pause = Math.min(2 * pause, 5000);
  }
}

function askForToken() {
  $("ask").hidden = false;
  $("token").focus();
  return new Promise((resolve) => {
    $("ask").onsubmit = (event) => {
      event.preventDefault();
      state.token = $("token").value.trim();
      sessionStorage.setItem("rtfarm-token", state.token);
      $("token").value = "";
      $("ask").hidden = true;
      resolve();
    };
  });
}

// Server-sent events, read here since a browser's own reader shows no token.
async function read(body, job) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let parts = [];
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    parts.push(value);
    if (!value.includes("\n") && !value.startsWith("\n")) continue;
    const texts = parts.join("").split("\n\n");
    parts = [texts.pop()];
    for (const text of texts) {
      const event = {};
      for (const line of text.split("\n")) {
        const colon = line.indexOf(": ");
        if (colon > 0) event[line.slice(0, colon)] = line.slice(colon + 2);
      }
      if (!event.event || job !== state.job) continue;
      await take[event.event]?.(JSON.parse(event.data));
      state.seen = event.id;
    }
  }
}

const take = {
  async picture(whole) {
    const bitmap = await decode(whole.png);
    state.picture = whole;
    state.rays = [];
    for (const canvas of [picture, coarse]) {
      canvas.width = whole.viewWidth;
      canvas.height = whole.viewHeight;
    }
    const brush = picture.getContext("2d");
    brush.drawImage(bitmap, 0, 0);
    const bits = whole.done && Uint8Array.from(atob(whole.done), (c) => c.charCodeAt(0));
    state.done = new Uint8Array(whole.count);
    for (let tile = 0; tile < whole.count; tile++) {
      state.done[tile] = bits ? (bits[tile >> 3] >> (tile & 7)) & 1 : 1;
      if (!state.done[tile]) brush.clearRect(...rectangle(tile));
    }
    if (whole.coarse) await take.coarse({ png: whole.coarse });
    if (state.fits) fit(); else place();
  },
  async coarse({ png }) {
    const bitmap = await decode(png);
    coarse.getContext("2d").drawImage(bitmap, 0, 0, coarse.width, coarse.height);
  },
  async tiles({ tiles, png }) {
    const bitmap = png && (await decode(png));
    const brush = picture.getContext("2d");
    let from = 0;
    for (const [tile] of tiles) {
      const [x, y, width, height] = rectangle(tile);
      if (width && height) brush.drawImage(bitmap, 0, from, width, height, x, y, width, height);
      from += height;
      state.done[tile] = 1;
    }
    state.work = state.work.filter(([tile]) => !state.done[tile]);
    mark();
  },
  status(status) {
    Object.assign(state, { jobs: status.jobs, work: status.work });
    state.workers = new Map(status.workers.map((worker) => [worker.worker, worker]));
    showJobs();
    showWorkers();
    showProgress();
    mark();
    const wanted = wantedJob();
    if (wanted !== state.job) {
      Object.assign(state, { job: wanted, seen: null, picture: null, fits: true, rays: [] });
      state.call.abort();
    }
  },
  log(events) {
    for (const event of events) {
      const { time, event: name, ...fields } = event;
      const words = Object.entries(fields).map(([key, value]) => `${key} ${Array.isArray(value) ? value.join(",") : value}`);
      const at = new Date(1000 * time);
      const stamp = make("time", at.toLocaleTimeString());
      stamp.dateTime = at.toISOString();
      const line = make("li", "", stamp, make("span", name), make("span", words.length ? `, ${words.join(", ")}` : "", "soft"));
      line.dataset.key = JSON.stringify(event);
      if ([...$("log").children].some((known) => known.dataset.key === line.dataset.key)) continue;
      $("log").prepend(line);
    }
    while ($("log").children.length > 100) $("log").lastChild.remove();
  },
};

function wantedJob() {
  const { jobs, chosen, job } = state;
  if (chosen && jobs.some((known) => known.job === chosen)) return chosen;
  const underWay = jobs.find((known) => known.state === "rendering") ?? jobs.find((known) => known.state === "waiting");
  if (underWay) return underWay.job;
  return jobs.some((known) => known.job === job) ? job : (jobs.at(-1)?.job ?? null);
}

async function decode(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  // The numbers as they are.
  return createImageBitmap(new Blob([bytes], { type: "image/png" }), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

// What a view shows of a tile: x, y, width and height.
function rectangle(tile) {
  const { side, columns, width, height, step } = state.picture;
  const [column, row] = [tile % columns, Math.floor(tile / columns)];
  const [x0, y0] = [column * side, row * side].map((place) => Math.ceil(place / step));
  const x1 = Math.ceil(Math.min(width, (column + 1) * side) / step);
  const y1 = Math.ceil(Math.min(height, (row + 1) * side) / step);
  return [x0, y0, x1 - x0, y1 - y0];
}

// An element with text or children; the last word may be its class.
function make(name, text, ...more) {
  const element = document.createElement(name);
  if (text) element.textContent = text;
  for (const part of more) {
    if (typeof part === "string") element.className = part; else element.append(part);
  }
  return element;
}

function row(...cells) {
  return make("tr", "", ...cells);
}

function color(worker) {
  return `hsl(${(worker * 137) % 360} 85% 58%)`;
}

function showWorkers() {
  const rows = [...state.workers.values()].map((worker) => {
    const dot = make("span", "", "dot");
    dot.style.background = color(worker.worker);
    const number = make("td", "", dot, document.createTextNode(worker.worker));
    const host = make("td", worker.host || "–");
    const notes = [worker.isa, worker.standing === "active" ? "" : worker.standing, worker.silence > 5 ? `silent for ${worker.silence} s` : ""];
    host.append(make("span", ` ${notes.filter(Boolean).join(", ")}`, "soft"));
    return row(number, host, make("td", `${worker.threads}`, "n"), make("td", `${worker.leased}`, "n"), make("td", `${worker.done}`, "n"));
  });
  $("workers").replaceChildren(...rows);
  $("nobody").hidden = rows.length > 0;
}

function showJobs() {
  const options = state.jobs.map((job) => {
    const option = make("option", `${job.name || job.job} (${job.state})`);
    option.value = job.job;
    return option;
  });
  const select = $("job");
  const known = [...select.options].map((option) => option.value + option.text).join();
  if (known !== options.map((option) => option.value + option.text).join()) {
    select.replaceChildren(...(options.length ? options : [make("option", "none yet")]));
  }
  const wanted = wantedJob();
  if (wanted && select.value !== wanted) select.value = wanted;
  $("jobs").replaceChildren(...state.jobs.map((job) => {
    const name = make("button", job.name || job.job);
    name.type = "button";
    name.onclick = () => choose(job.job);
    const share = `${Math.floor((100 * job.done) / Math.max(job.count, 1))} %`;
    return row(make("td", "", name), make("td", job.owner || "–"), make("td", job.state, job.state === "failed" ? "bad" : ""), make("td", share, "n"));
  }));
}

function choose(job) {
  state.chosen = job;
  take.status({ jobs: state.jobs, work: state.work, workers: [...state.workers.values()] });
}

function showProgress() {
  const job = state.jobs.find((known) => known.job === state.job);
  const nothing = "–";
  $("bar").value = job ? job.done / Math.max(job.count, 1) : 0;
  const isOver = job && (job.state === "finished" || job.state === "failed");
  const text = {
    tiles: job ? `${job.done} of ${job.count}` : nothing,
    left: !job || job.left == null ? (isOver ? "none" : nothing) : `${time(job.left)} ± ${time(job.leftError)}`,
    rate: nothing,
    rays: job ? count(job.rays) : nothing,
    error: job?.error == null ? nothing : job.error.toExponential(2),
    time: job ? time(job.seconds) : nothing,
    size: job ? `${job.width} × ${job.height}` : nothing,
  };
  if (job) {
    const now = performance.now() / 1000;
    state.rays.push([now, job.rays]);
    while (state.rays.length > 2 && state.rays[0][0] < now - 5) state.rays.shift();
    const [[from, first]] = state.rays;
    const overall = job.rays / Math.max(job.seconds, 0.1);
    const lately = now - from > 1 ? (job.rays - first) / (now - from) : overall;
    text.rate = count(isOver ? overall : lately);
  }
  for (const [id, value] of Object.entries(text)) if ($(id).textContent !== value) $(id).textContent = value;
  const reason = job?.reason ?? "";
  if ($("reason").textContent !== reason) $("reason").textContent = reason;
  $("reason").hidden = !reason;
  document.title = job ? `${$("bar").value < 1 ? `${Math.floor(100 * $("bar").value)} % ` : ""}${job.name || job.job} – rtfarm` : "rtfarm";
  picture.setAttribute("aria-label", job ? `${job.name}, ${text.tiles} tiles, ${job.state}` : "No picture yet");
}

function count(number) {
  for (const [unit, size] of [["G", 1e9], ["M", 1e6], ["k", 1e3]]) {
    if (number >= size) return `${(number / size).toFixed(1)} ${unit}`;
  }
  return number.toFixed(0);
}

function time(seconds) {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${seconds.toFixed(0)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 120 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

// Zooming. A place on the stage is the view's place times `zoom`, plus `x` and `y`.

function fit() {
  if (!state.picture) return;
  const { viewWidth, viewHeight } = state.picture;
  state.zoom = Math.min(stage.clientWidth / viewWidth, stage.clientHeight / viewHeight);
  state.x = (stage.clientWidth - viewWidth * state.zoom) / 2;
  state.y = (stage.clientHeight - viewHeight * state.zoom) / 2;
  state.fits = true;
  place();
}

function zoomBy(factor, [x, y] = [stage.clientWidth / 2, stage.clientHeight / 2]) {
  const zoom = Math.min(Math.max(state.zoom * factor, 0.02), 64);
  state.x = x - ((x - state.x) * zoom) / state.zoom;
  state.y = y - ((y - state.y) * zoom) / state.zoom;
  state.zoom = zoom;
  state.fits = false;
  place();
}

function place() {
  for (const canvas of [picture, coarse]) {
    canvas.style.transform = `translate(${state.x}px, ${state.y}px) scale(${state.zoom})`;
  }
  coarse.style.backgroundSize = `${32 / state.zoom}px ${32 / state.zoom}px`;
  picture.className = state.zoom > 1.5 ? "pixelated" : "";
  mark();
}

// Outlines the tiles in work in their workers' colours, and the pixel that is read.
function mark() {
  const ratio = devicePixelRatio || 1;
  const [width, height] = [stage.clientWidth, stage.clientHeight];
  if (marks.width !== Math.round(width * ratio) || marks.height !== Math.round(height * ratio)) {
    [marks.width, marks.height] = [Math.round(width * ratio), Math.round(height * ratio)];
  }
  const brush = marks.getContext("2d");
  brush.setTransform(ratio, 0, 0, ratio, 0, 0);
  brush.clearRect(0, 0, width, height);
  if (!state.picture) return;
  const outline = (x, y, w, h, paint, thickness) => {
    const box = [state.x + x * state.zoom, state.y + y * state.zoom, Math.max(w * state.zoom, 2), Math.max(h * state.zoom, 2)];
    for (const [style, extra] of [["#000a", 2], [paint, 0]]) {
      brush.strokeStyle = style;
      brush.lineWidth = thickness + extra;
      brush.strokeRect(...box);
    }
  };
  for (const isBegun of [0, 1]) {
    for (const [tile, worker, begun] of state.work) {
      if (begun !== isBegun || state.done[tile]) continue;
      brush.globalAlpha = begun ? 1 : 0.7;
      outline(...rectangle(tile), color(worker), begun ? 2 : 1);
    }
  }
  brush.globalAlpha = 1;
  if (state.cursor) {
    const { step } = state.picture;
    outline(state.cursor[0] / step, state.cursor[1] / step, 1 / step, 1 / step, "#fff", 1.5);
  }
}

// Reading pixels.

function pixelAt(event) {
  if (!state.picture) return null;
  const box = stage.getBoundingClientRect();
  const { step } = state.picture;
  const place = [(event.clientX - box.left - stage.clientLeft - state.x) / state.zoom, (event.clientY - box.top - stage.clientTop - state.y) / state.zoom];
  return place.map((value) => Math.floor(value) * step);
}

function readPixel(pixel) {
  const whole = state.picture;
  const isInside = whole && pixel && pixel[0] >= 0 && pixel[1] >= 0 && pixel[0] < whole.width && pixel[1] < whole.height;
  state.cursor = isInside ? pixel : null;
  mark();
  if (!isInside) return;
  const [x, y] = pixel;
  const tile = Math.floor(y / whole.side) * whole.columns + Math.floor(x / whole.side);
  const where = `(${x + whole.x0}, ${y + whole.y0}) in tile ${tile}`;
  const asked = ++state.asked;
  const tell = (text) => { if (asked === state.asked) $("pixel").textContent = `${where}: ${text}`; };
  if (!state.done[tile]) {
    const inWork = state.work.find(([known]) => known === tile);
    const host = inWork && state.workers.get(inWork[1])?.host;
    tell(inWork ? `in the hands of worker ${inWork[1]}${host ? ` on ${host}` : ""}` : "not rendered yet");
  } else if (whole.exact) {
    tell([...picture.getContext("2d").getImageData(x, y, 1, 1).data.slice(0, 3)].join(", "));
  } else {
    tell("…");
    fetch(`/page/pixel?job=${whole.job}&x=${x}&y=${y}`, { headers: headers({}) })
      .then((answer) => answer.json())
      .then(({ rgb }) => tell(rgb.map((value) => Number(value.toPrecision(7))).join(", ")))
      .catch(() => tell("no answer"));
  }
}

const fingers = new Map();

stage.addEventListener("pointerdown", (event) => {
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  stage.setPointerCapture(event.pointerId);
  readPixel(pixelAt(event));
});
stage.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return void readPixel(pixelAt(event));
  const others = [...fingers].filter(([id]) => id !== event.pointerId);
  const now = [event.clientX, event.clientY];
  if (others.length) {
    const [[, other]] = others;
    const box = stage.getBoundingClientRect();
    const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
    zoomBy(distance(now, other) / distance(before, other), [other[0] - box.left, other[1] - box.top]);
  } else {
    state.x += now[0] - before[0];
    state.y += now[1] - before[1];
    state.fits &&= now[0] === before[0] && now[1] === before[1];
    place();
  }
  fingers.set(event.pointerId, now);
});
for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, (event) => fingers.delete(event.pointerId));
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  const box = stage.getBoundingClientRect();
  zoomBy(Math.exp(-event.deltaY / 400), [event.clientX - box.left, event.clientY - box.top]);
}, { passive: false });

stage.addEventListener("keydown", (event) => {
  const whole = state.picture;
  if (!whole || event.ctrlKey || event.altKey || event.metaKey) return;
  const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const acts = { "+": () => zoomBy(1.5, cursorPlace()), "=": () => zoomBy(1.5, cursorPlace()), "-": () => zoomBy(1 / 1.5, cursorPlace()), 0: fit, 1: actualSize };
  if (moves[event.key]) {
    const far = whole.step * (event.shiftKey ? 10 : 1);
    const middle = [whole.width, whole.height].map((side) => Math.floor(side / 2 / whole.step) * whole.step);
    const from = state.cursor ?? middle;
    const to = from.map((value, axis) => value + moves[event.key][axis] * far);
    readPixel([Math.min(Math.max(to[0], 0), whole.width - 1), Math.min(Math.max(to[1], 0), whole.height - 1)]);
  } else if (acts[event.key]) {
    acts[event.key]();
  } else return;
  event.preventDefault();
});

function cursorPlace() {
  if (!state.cursor) return undefined;
  const { step } = state.picture;
  return [state.x + (state.cursor[0] / step) * state.zoom, state.y + (state.cursor[1] / step) * state.zoom];
}

function actualSize() {
  zoomBy(1 / state.zoom / (devicePixelRatio || 1));
}

$("in").onclick = () => zoomBy(1.5);
$("out").onclick = () => zoomBy(1 / 1.5);
$("fit").onclick = fit;
$("one").onclick = actualSize;
$("job").onchange = () => choose($("job").value);
new ResizeObserver(() => (state.fits ? fit() : mark())).observe(stage);

readFragment();
state.job = state.chosen;
follow();
