"use strict";
/* Camera images of a frame, with the ellipses that were found in them. */

class Images {
  /* time is a function that returns the time of a frame in s, or null if nothing moves. */
  constructor(time) {
    this.time = time;
    this.shown = null;
    this.listen();
  }

  /* On a click, magnify an image around the clicked place, or show the whole image again. */
  listen() {
    document.querySelectorAll(".image button").forEach((button) => {
      button.addEventListener("click", (event) => {
        const box = button.getBoundingClientRect();
        const byKey = !event.detail;
        const [x, y] = byKey ? [box.width / 2, box.height / 2] : [event.clientX - box.left, event.clientY - box.top];
        const large = button.getAttribute("aria-pressed") === "true";
        if (!large) button.firstElementChild.style.transformOrigin = `${x}px ${y}px`;
        button.setAttribute("aria-pressed", String(!large));
      });
    });
  }

  /* look contains the images of a frame, their corners in the whole images, and the detected stickers. */
  show(look) {
    if (look === this.shown) return;
    this.shown = look;
    document.querySelectorAll(".image").forEach((figure) => {
      const side = Number(figure.dataset.side);
      figure.querySelector("img").src = look.images[side];
      const svg = figure.querySelector("svg");
      const [x, y] = look.corners[side];
      svg.setAttribute("viewBox", `${x - 0.5} ${y - 0.5} ${look.size.join(" ")}`);
      svg.replaceChildren();
      let count = 0;
      for (const [body, found] of Object.entries(look.found)) {
        count += found.ids.length;
        found.centres[side].forEach((centre, k) => {
          const shape = found.shapes.length ? found.shapes[side][k] : null;
          this.ellipse(svg, centre, shape, `var(--${body})`, `${body} ${found.ids[k]}`);
        });
      }
      const time = this.time(look.frame);
      const moment = time === null ? "" : ` at ${time.toFixed(2)} s`;
      const words = `What the ${side ? "right" : "left"} camera sees${moment}: ${count} stickers found`;
      figure.querySelector("figcaption").textContent = `${words} (click to magnify)`;
    });
  }

  ellipse(svg, [x, y], shape, colour, name) {
    const halo = element("circle", { class: "halo", cx: x, cy: y, r: 16, stroke: colour }, svg);
    element("title", {}, halo).textContent = name;
    if (!shape) return;
    const [[a, b], [c, d]] = shape;
    element("ellipse", { rx: 1, ry: 1, stroke: colour, transform: `matrix(${a} ${c} ${b} ${d} ${x} ${y})` }, svg);
  }
}
