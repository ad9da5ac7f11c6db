// The page: camera, controls, playing.

const RAMPS = {
  bonds: [[8, 26, 217], [217, 10, 8]], // blue cut, red whole, as in pictures
  strain: [[33, 80, 190], [120, 160, 220], [215, 215, 215], [232, 150, 110], [190, 40, 30]],
  curvature: [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]],
};
const LABELS = {
  hydrogen: "hydrogen bonds", ionic: "ionic bonds", disulfide: "disulfide bonds",
  peptide: "peptide bonds",
};

const element = (id) => document.getElementById(id);
const stage = element("stage"), slider = element("frame"), select = element("field");

function say(text, then) {
  element("message").textContent = text;
  element("message").hidden = !text;
  element("message").onclick = then || null;
}

async function main() {
  if (!globalThis.DecompressionStream) {
    say("This browser is too old to show hair in three dimensions: it lacks DecompressionStream.");
    return;
  }
  const of = await readRecording();
  const last = of.times.length - 1;
  const state = { frame: of.frame, field: of.colorBy, playing: null, camera: null };
  let drawing = null, canvas = null, pending = 0, changed = true;
  const pointers = new Map();
  let busy = false, share = 1, rest = 0;

  // A new canvas each time, because one whose context is lost stays blank.
  function open() {
    if (canvas) canvas.remove();
    canvas = document.createElement("canvas");
    stage.append(canvas);
    try {
      drawing = createDrawing(canvas, of);
    } catch (error) {
      drawing = null;
      say(`Hair in three dimensions needs WebGL 2, which this browser does not offer here `
        + `(${error.message}).`);
      return;
    }
    say("");
    canvas.addEventListener("webglcontextlost", () => {
      drawing = null;
      say("The browser has dropped this picture, as it does where many are open. "
        + "Click to draw it again.", open);
    });
    if (drawing.slow) share = drawing.setShare(0.1);
    changed = true;
    resize();
  }

  function resize() {
    const ratio = globalThis.devicePixelRatio || 1;
    canvas.width = Math.max(1, Math.round(stage.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(stage.clientHeight * ratio));
    if (!state.camera) state.camera = firstCamera();
    redraw();
  }

  // All that the box holds is seen, unless a distance is given.
  function firstCamera() {
    const { azimuth, elevation, target, distance } = of.view;
    const middle = target || of.box[0].map((x, k) => (x + of.box[1][k]) / 2);
    const back = direction(azimuth, elevation), [right, up] = axes(back);
    const aspect = canvas.width / canvas.height;
    let needed = 1e-3;
    for (let corner = 0; corner < 8; corner++) {
      const place = [0, 1, 2].map((k) => of.box[(corner >> k) & 1][k] - middle[k]);
      for (const [axis, tan] of [[right, HALF_TAN * aspect], [up, 0.92 * HALF_TAN]]) {
        needed = Math.max(needed, (1.06 * Math.abs(dot(place, axis))) / tan + dot(place, back));
      }
    }
    return { azimuth, elevation, target: [...middle], distance: distance || needed };
  }

  const back = () => direction(state.camera.azimuth, state.camera.elevation);
  const metresAPixel = () => (2 * HALF_TAN * state.camera.distance) / stage.clientHeight;

  function drawNow() {
    pending = 0;
    if (!drawing) return;
    const start = performance.now();
    drawing.setShare(busy ? share : 1);
    if (changed) drawing.setFrame(state.frame, state.field, state.field && rampOf(state.field));
    changed = false;
    const { target, distance } = state.camera, towards = back();
    drawing.draw(target.map((x, k) => x + distance * towards[k]), target);
    showScale();
    if (busy) adapt(start);
  }

  // While something moves, as many hairs are drawn as can be in a twenty-fifth of a second, which
  // matters without a graphics card; a moment later all of them.
  function adapt(start) {
    drawing.wait();
    const took = performance.now() - start;
    if (took > 40 || (took < 20 && share < 1)) {
      share = drawing.setShare(share * Math.min(Math.max(30 / took, 0.2), 1.5));
    }
    rest = setTimeout(settle, 250);
  }

  function settle() {
    clearTimeout(rest);
    if (pointers.size || state.playing) {
      rest = setTimeout(settle, 250);
      return;
    }
    busy = false;
    changed = true;
    redraw();
  }

  function redraw(moves = false) {
    busy ||= moves;
    if (moves) clearTimeout(rest);
    if (!pending) pending = requestAnimationFrame(drawNow);
  }

  function rampOf(field) {
    return RAMPS[field] || RAMPS.bonds;
  }

  function showScale() {
    const most = 0.18 * stage.clientWidth * metresAPixel();
    const power = 10 ** Math.floor(Math.log10(most));
    const length = power * Math.max(...[1, 2, 5].filter((step) => step * power <= most));
    element("scale").firstElementChild.style.width = `${length / metresAPixel()}px`;
    const [number, unit] = length >= 0.01 ? [100 * length, "cm"] : [1000 * length, "mm"];
    element("scale").lastElementChild.textContent = `${Number(number.toPrecision(3))} ${unit}`;
  }

  function showFrame(frame) {
    state.frame = Math.min(Math.max(frame, 0), last);
    changed = true;
    slider.value = state.frame;
    const phase = of.phases[state.frame] || "start";
    const time = `${of.times[state.frame].toFixed(2)} s, ${phase}`;
    element("time").textContent = `${time}, frame ${state.frame + 1} of ${last + 1}`;
    element("time").title = time;
    redraw();
  }

  function showField(field) {
    state.field = field || null;
    changed = true;
    select.value = field || "";
    element("bar").hidden = !field;
    if (field) {
      const { low, high, unit } = of.fields[field];
      const percent = field === "strain";
      const text = (x) => (percent ? `${Number((100 * x).toPrecision(2))} %` : `${x}`);
      element("low").textContent = text(low);
      element("high").textContent = text(high);
      element("unit").textContent = unit;
      const stops = rampOf(field).map((c) => `rgb(${c.join(",")})`).join(", ");
      element("ramp").style.background = `linear-gradient(to right, ${stops})`;
    }
    redraw();
  }

  function play(on) {
    element("play").textContent = on ? "pause" : "play";
    state.playing = null;
    if (!on || last === 0) return;
    if (state.frame === last) showFrame(0);
    const playing = { since: null, from: of.times[state.frame] };
    state.playing = playing;
    requestAnimationFrame(function next(now) {
      if (state.playing !== playing) return;
      playing.since ??= now;
      const time = playing.from + (now - playing.since) / 1000;
      let frame = state.frame;
      while (frame < last && of.times[frame + 1] <= time + 1e-6) frame += 1;
      if (frame !== state.frame) {
        showFrame(frame);
        redraw(true);
      }
      if (frame === last) play(false);
      else requestAnimationFrame(next);
    });
  }

  function step(by) {
    play(false);
    showFrame(state.frame + by);
  }

  function reset() {
    state.camera = firstCamera();
    redraw();
  }

  function turn(dx, dy) {
    state.camera.azimuth -= dx * 0.008;
    const up = state.camera.elevation + dy * 0.008, most = Math.PI / 2 - 1e-3;
    state.camera.elevation = Math.min(Math.max(up, -most), most);
    redraw(true);
  }

  function move(dx, dy) {
    const [right, up] = axes(back()), by = metresAPixel();
    state.camera.target = state.camera.target.map(
      (x, k) => x + by * (dy * up[k] - dx * right[k]),
    );
    redraw(true);
  }

  function zoom(factor) {
    const radius = drawing ? drawing.radius : 1;
    const distance = state.camera.distance * factor;
    state.camera.distance = Math.min(Math.max(distance, 0.05 * radius), 50 * radius);
    redraw(true);
  }

  // One pointer turns or moves; two move, and zoom by how far apart they are.
  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId);
    stage.focus({ preventScroll: true });
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  stage.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before || !state.camera) return;
    const now = { x: event.clientX, y: event.clientY };
    const dx = now.x - before.x, dy = now.y - before.y;
    if (pointers.size === 2) {
      const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
      const apart = (p) => Math.max(Math.hypot(p.x - other.x, p.y - other.y), 1);
      zoom(apart(before) / apart(now));
      move(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 2 || event.buttons & 4) {
      move(dx, dy);
    } else {
      turn(dx, dy);
    }
    pointers.set(event.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    if (state.camera) zoom(Math.exp(Math.min(Math.max(event.deltaY * lines, -200), 200) * 0.0015));
  }, { passive: false });

  const keys = {
    " ": () => play(!state.playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1),
    Home: () => step(-last), End: () => step(last), r: reset, R: reset,
  };
  document.addEventListener("keydown", (event) => {
    const own = { SELECT: true, BUTTON: event.key === " " }[event.target.tagName];
    if (own || event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  element("play").addEventListener("click", () => play(!state.playing));
  element("reset").addEventListener("click", reset);
  slider.addEventListener("input", () => {
    play(false);
    showFrame(Number(slider.value));
    redraw(true);
  });
  select.addEventListener("change", () => showField(select.value));

  slider.max = last;
  select.append(new Option("plain hair", ""));
  for (const name of Object.keys(of.fields)) select.append(new Option(LABELS[name] || name, name));
  element("note").textContent = of.note;
  element("note").hidden = !of.note;
  open();
  showField(of.colorBy);
  showFrame(of.frame);
  new ResizeObserver(() => canvas && resize()).observe(stage);

  // For tests and measurements: whether all is drawn, and the time [ms] to show a frame with all
  // hairs, or to show the same one once more.
  globalThis.jaxhair = {
    state,
    settled: () => Boolean(drawing) && !pending && !busy && !state.playing,
    share: () => share,
    milliseconds(frame) {
      const start = performance.now();
      if (frame !== undefined) showFrame(frame);
      drawNow();
      drawing.wait();
      return performance.now() - start;
    },
  };
}

main().catch((error) => say(`This page cannot be shown: ${error.message}`));
