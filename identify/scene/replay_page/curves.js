"use strict";
/* Curves over time in small panels, with a cursor that all of them share. */

/* Return about ``count`` round numbers between two values. */
function roundNumbers(low, high, count) {
  const rough = (high - low) / count;
  const decade = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((factor) => factor * decade >= rough) * decade;
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high + 1e-9 * step; k += 1) {
    found.push(Number((k * step).toPrecision(12)));
  }
  return found;
}

function element(name, attributes, parent) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent.append(made);
  return made;
}

class Panel {
  /* seek is a function of a time, which is called when the panel is clicked. */
  constructor(parent, name, time, seek) {
    this.time = time;
    this.box = document.createElement("div");
    this.box.className = "panel";
    parent.append(this.box);
    this.text("name", name, {});
    const whole = { viewBox: "0 0 1 1", preserveAspectRatio: "none", role: "img", "aria-label": name };
    this.svg = element("svg", whole, this.box);
    const at = (event) => {
      const box = this.svg.getBoundingClientRect();
      const share = (event.clientX - box.left) / box.width;
      if (event.buttons || event.type === "pointerdown") seek(time[0] + share * (time[time.length - 1] - time[0]));
    };
    this.svg.addEventListener("pointerdown", at);
    this.svg.addEventListener("pointermove", at);
  }

  text(kind, words, style) {
    const span = document.createElement("span");
    span.className = kind;
    span.textContent = words;
    Object.assign(span.style, style);
    this.box.append(span);
    return span;
  }

  /* Replace the curves. Each has a value per frame (NaN if there is none), a colour and a dash pattern. */
  draw(curves) {
    this.svg.replaceChildren();
    this.box.querySelectorAll(".tick").forEach((span) => span.remove());
    let [low, high] = [Infinity, -Infinity];
    for (const { values } of curves) for (const value of values) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (!(high >= low)) [low, high] = [-1, 1];
    const room = Math.max(0.06 * (high - low), 1e-9 * Math.max(Math.abs(low), Math.abs(high)), 1e-12);
    [low, high] = [low - room, high + room];
    this.first = this.time[0];
    this.length = this.time[this.time.length - 1] - this.first;
    const down = (value) => 1 - (value - low) / (high - low);
    for (const value of roundNumbers(low, high, 5)) {
      element("line", { class: "grid", x1: 0, x2: 1, y1: down(value), y2: down(value) }, this.svg);
      const top = `calc(1.4rem + (100% - 2.8rem) * ${down(value)} - 0.55rem)`;
      this.text("tick", String(value).replace("-", "−"), { right: "calc(100% - 3.4rem)", top });
    }
    for (const value of roundNumbers(this.first, this.first + this.length, 5)) {
      const left = `calc(3.6rem + (100% - 4rem) * ${(value - this.first) / this.length})`;
      this.text("tick", `${value} s`, { left, bottom: "0", transform: "translateX(-50%)" });
    }
    for (const curve of curves) this.path(curve, down);
    this.cursor = element("line", { class: "cursor", y1: 0, y2: 1 }, this.svg);
  }

  path({ values, colour, dash, width }, down) {
    let [drawn, pen] = ["", "M"];
    for (let k = 0; k < values.length; k += 1) {
      if (!Number.isFinite(values[k])) { pen = "M"; continue; }
      drawn += `${pen}${((this.time[k] - this.first) / this.length).toFixed(5)} ${down(values[k]).toFixed(4)}`;
      pen = "L";
    }
    element("path", { d: drawn, stroke: colour, "stroke-dasharray": dash, "stroke-width": width }, this.svg);
  }

  at(time) {
    const share = (time - this.first) / this.length;
    this.cursor.setAttribute("x1", share);
    this.cursor.setAttribute("x2", share);
  }
}
