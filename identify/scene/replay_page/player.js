"use strict";
/* Player of the page: it sets a common time for scene, images, figures and curves.
   Other scripts can control it through `window.replay`. */

const WORDS = {
  legs: "legs", cameras: "cameras and their field of view", rays: "rays to the stickers that were found",
  ellipsoid: "ellipsoid of the measured position × ", stickers: "ellipsoids of the stickers × ",
  measured: "measured, difference × ", identified: "identified model, difference × ",
  starting: "initial model, difference × ", true: "true pose, in which the robot is drawn",
};
const SHORT = { true: "true", measured: "measured", identified: "identified model", starting: "initial model" };
const DASHES = { true: "none", measured: "none", identified: "7 2", starting: "2 3" };
const WIDTHS = { true: 2.4, measured: 1, identified: 1.6, starting: 1.6 };
const SAMPLES = {
  rays: "#c8102e", ellipsoid: "var(--measured)", stickers: "var(--platform)", cameras: "var(--soft)", legs: "#c9723a",
};
const OFF_AT_FIRST = ["starting"];
const NAMES = ["x", "y", "z", "α", "β", "γ"];

/* Return a number with a minus sign in place of a hyphen. */
function typographic(value, digits) {
  return value.toFixed(digits).replace("-", "−");
}

class Replay {
  constructor(data) {
    this.data = data;
    this.ready = false;
    this.time = numbers(data.time, Float64Array);
    this.tables = { drawn: numbers(data.drawn, Float64Array) };
    for (const [kind, text] of Object.entries(data.poses)) this.tables[kind] = numbers(text, Float64Array);
    this.frame = 0;
    this.off = new Set(OFF_AT_FIRST);
    this.scene = null;
    this.panels = { poses: [], differences: [] };
  }

  /* Return the pose [x y z alpha beta gamma] of a kind in a frame, in m and rad, or null. */
  pose(kind, frame) {
    const table = this.tables[kind];
    const row = table && Array.from(table.subarray(6 * frame, 6 * frame + 6));
    return row && row.every(Number.isFinite) ? row : null;
  }

  async start() {
    this.colours = this.readColours();
    if (!canDraw() || !(await this.showScene())) this.showStill();
    const differs = this.data.frames > 1 || this.data.looks.length > 0;
    document.getElementById("enlargement").hidden = !this.scene || !differs;
    this.buildLegend();
    this.images = new Images((frame) => (this.data.frames > 1 ? this.time[frame] : null));
    document.getElementById("enlarged").addEventListener("change", () => this.seek(this.frame));
    if (this.data.frames > 1) this.buildTime();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.colours = this.readColours();
      this.drawCurves();
      this.seek(this.frame);
    });
    this.seek(0);
    for (let k = 0; k < 2; k += 1) await new Promise(requestAnimationFrame); /* until the scene has been drawn */
    this.ready = true;
  }

  /* Build the scene in space. Return false where the browser cannot draw it after all. */
  async showScene() {
    try {
      this.scene = new Scene(this.data, document.getElementById("scene"), (kind, frame) => this.pose(kind, frame));
      await this.scene.build(this.colours);
    } catch (error) {
      return false;
    }
    document.getElementById("still").hidden = true;
    /* a browser takes the graphics away when too many pages draw, or when its driver ends */
    this.scene.renderer.domElement.addEventListener("webglcontextlost", () => this.showStill());
    return true;
  }

  /* Show a still picture in place of the scene, and say why. */
  showStill() {
    if (this.scene) this.scene.renderer.domElement.remove();
    this.scene = null;
    document.getElementById("still").hidden = false;
    document.getElementById("badge").hidden = true;
    document.getElementById("enlargement").hidden = true;
    document.getElementById("without-webgl").hidden = false;
    document.querySelector("#scene figcaption").hidden = true;
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    const names = ["soft", "true", "measured", "identified", "starting", "platform", "base"];
    return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  }

  buildLegend() {
    const layers = Object.entries(this.scene ? this.scene.layers : {}).filter(([, objects]) => objects.length);
    const names = [...new Set([...Object.keys(this.data.poses), ...layers.map(([name]) => name)])];
    for (const name of names) {
      const [item, label, box] = ["li", "label", "input"].map((tag) => document.createElement(tag));
      box.type = "checkbox";
      box.checked = !this.off.has(name);
      box.dataset.layer = name;
      box.disabled = name === "true";
      box.addEventListener("change", () => this.toggle(name, box.checked));
      const words = document.createElement("span");
      words.dataset.words = name;
      label.append(box, this.sample(name), words);
      item.append(label);
      document.getElementById("legend").append(item);
      if (this.scene && this.off.has(name)) this.scene.showLayer(name, false);
    }
  }

  words(name) {
    if (name === "true" && this.data.frames === 1) return "the platform at home";
    if (name === "measured" && !this.data.poses.true) return "measured pose, in which the robot is drawn";
    if (!this.scene) return SHORT[name];
    return WORDS[name].endsWith(" ") ? WORDS[name] + this.times().toLocaleString("en") : WORDS[name];
  }

  sample(name) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 40 16");
    const colour = SAMPLES[name] || `var(--${name})`;
    if (name === "ellipsoid" || name === "stickers") {
      element("ellipse", { cx: 20, cy: 8, rx: 14, ry: 6, fill: colour, opacity: 0.6 }, svg);
    } else {
      const line = { d: "M2 8H38", stroke: colour, "stroke-width": WIDTHS[name] || 2 };
      element("path", { ...line, "stroke-dasharray": DASHES[name] || "none" }, svg);
    }
    return svg;
  }

  toggle(name, shown) {
    this.off[shown ? "delete" : "add"](name);
    if (this.scene) this.scene.showLayer(name, shown);
    this.drawCurves();
    this.seek(this.frame);
  }

  buildTime() {
    this.slider = document.getElementById("time");
    this.slider.max = this.data.frames - 1;
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    document.getElementById("play").addEventListener("click", () => this.play(!this.playing));
    const seek = (time) => this.seek(this.frameAt(time));
    const lengths = NAMES.map((name, k) => `${name} [${k < 3 ? "mm" : "mrad"}]`);
    const errors = NAMES.map((name, k) => `${name} [${k < 3 ? "µm" : "µrad"}]`);
    for (const [place, names] of [["poses", lengths], ["differences", errors]]) {
      this.panels[place] = names.map((name) => new Panel(document.getElementById(place), name, this.time, seek));
    }
    this.choice = document.getElementById("difference");
    const known = Object.keys(this.data.poses);
    if (known.includes("true")) this.choice.append(new Option("measured pose and models minus the true pose", "true"));
    if (known.includes("identified")) this.choice.append(new Option("residuals: measured pose minus the model", "residual"));
    this.choice.closest("section").hidden = !this.choice.options.length;
    this.choice.addEventListener("change", () => { this.drawCurves(); this.seek(this.frame); });
    this.drawCurves();
  }

  frameAt(time) {
    const after = this.time.findIndex((value) => value >= time);
    if (after <= 0) return after < 0 ? this.time.length - 1 : 0;
    return time - this.time[after - 1] < this.time[after] - time ? after - 1 : after;
  }

  kinds() {
    return Object.keys(this.data.poses).filter((kind) => !this.off.has(kind));
  }

  column(kind, k, scale, less) {
    const [from, other] = [this.tables[kind], less && this.tables[less]];
    return Float64Array.from(this.time, (_, n) => scale * (from[6 * n + k] - (other ? other[6 * n + k] : 0)));
  }

  drawCurves() {
    if (!this.choice) return;
    const look = (kind) => ({ colour: this.colours[kind], dash: DASHES[kind], width: WIDTHS[kind] });
    this.panels.poses.forEach((panel, k) => {
      panel.draw(this.kinds().map((kind) => ({ values: this.column(kind, k, 1e3), ...look(kind) })));
    });
    const residual = this.choice.value === "residual";
    const shown = this.kinds().filter((kind) => kind !== "true" && !(residual && kind === "measured"));
    const alone = shown.length === 1 ? { dash: "none", width: 1 } : {};
    const difference = (kind, k) => {
      return residual ? this.column("measured", k, 1e6, kind) : this.column(kind, k, 1e6, "true");
    };
    this.writeKey("poses-key", this.kinds());
    this.writeKey("differences-key", shown);
    this.panels.differences.forEach((panel, k) => {
      panel.draw(shown.map((kind) => ({ values: difference(kind, k), ...look(kind), ...alone })));
    });
  }

  /* Write the key of the curves beside their title. */
  writeKey(place, kinds) {
    const entries = kinds.map((kind) => {
      const item = document.createElement("li");
      item.append(this.sample(kind), SHORT[kind]);
      return item;
    });
    document.getElementById(place).replaceChildren(...entries);
  }

  /* Return the nearest frame with images. */
  look(frame) {
    const away = (look) => Math.abs(look.frame - frame);
    return this.data.looks.reduce((best, look) => (!best || away(look) < away(best) ? look : best), null);
  }

  /* Return the factor that enlarges differences. */
  times() {
    return Number(document.getElementById("enlarged").value);
  }

  seek(frame) {
    this.frame = Math.max(0, Math.min(this.data.frames - 1, frame));
    const times = this.times();
    document.querySelectorAll("[data-words]").forEach((span) => { span.textContent = this.words(span.dataset.words); });
    this.writeBadge(times);
    const scale = `10 mm in the scene are ${1e4 / times} µm, 0.1 rad are ${1e5 / times} µrad`;
    document.getElementById("scale").textContent = scale;
    const look = this.look(this.frame);
    if (this.scene) this.scene.show(this.frame, look, times);
    if (look) this.images.show(look);
    if (!this.slider) return;
    const time = this.time[this.frame];
    this.slider.value = this.frame;
    document.getElementById("clock").textContent = `${time.toFixed(3)} s`;
    [...this.panels.poses, ...this.panels.differences].forEach((panel) => panel.at(time));
    this.writeFigures();
  }

  /* Explain the coloured outlines inside the scene, so that a screenshot contains the explanation. */
  writeBadge(times) {
    const badge = document.getElementById("badge");
    badge.hidden = !this.scene || this.data.frames === 1;
    badge.replaceChildren();
    for (const kind of this.kinds().filter((name) => name !== "true")) {
      const line = document.createElement("span");
      line.style.color = this.colours[kind];
      line.textContent = `${SHORT[kind]}: difference × ${times.toLocaleString("en")}`;
      badge.append(line);
    }
  }

  writeFigures() {
    const truth = this.pose("true", this.frame);
    const kinds = Object.keys(this.data.poses).filter((kind) => kind !== "true");
    const [large, small] = ["[mm,\u00a0mrad]", "[µm,\u00a0µrad]"];
    const titles = kinds.map((kind) => (truth ? `${SHORT[kind]} − true ${small}` : `${SHORT[kind]} ${large}`));
    const head = ["", truth ? `true ${large}` : "", ...titles];
    const rows = NAMES.map((name, k) => {
      const cells = kinds.map((kind) => {
        const pose = this.pose(kind, this.frame);
        if (!pose) return kind === "measured" ? "lost" : "none";
        return truth ? typographic(1e6 * (pose[k] - truth[k]), 2) : typographic(1e3 * pose[k], 4);
      });
      return [name, truth ? typographic(1e3 * truth[k], 4) : "", ...cells];
    });
    const table = document.getElementById("figures");
    table.replaceChildren();
    for (const cells of [head, ...rows]) {
      const row = table.insertRow();
      cells.forEach((cell, k) => {
        const place = document.createElement(k && cells !== head ? "td" : "th");
        place.textContent = cell;
        row.append(place);
      });
    }
  }

  play(on) {
    this.playing = on;
    const button = document.getElementById("play");
    button.textContent = on ? "❚❚" : "▶";
    button.setAttribute("aria-label", on ? "Pause" : "Play");
    if (!on) return;
    const last = this.time[this.time.length - 1];
    if (this.frame === this.data.frames - 1) this.seek(0);
    let [began, from, told] = [performance.now(), this.time[this.frame], this.frame];
    const step = (now) => {
      if (!this.playing) return;
      if (this.frame !== told) [began, from] = [now, this.time[this.frame]]; /* the slider was moved */
      const time = from + (Number(document.getElementById("speed").value) * Math.max(0, now - began)) / 1000;
      this.seek(this.frameAt(time));
      told = this.frame;
      if (time >= last) this.play(false);
      else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  /* Return what is shown: time in s, and poses [x y z alpha beta gamma] in m and rad, read from the
     objects in the scene. */
  shown() {
    return { frame: this.frame, time: this.time[this.frame], ...(this.scene ? this.scene.shown() : {}) };
  }
}

window.replay = new Replay(JSON.parse(document.getElementById("data").textContent));
window.replay.start();
