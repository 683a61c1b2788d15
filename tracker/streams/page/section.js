// The view from the side, in the mid-sagittal plane: the front of the mouth is on the left, as phoneticians draw it.

const MARGIN_MM = 9;
const TRAIL_MS = 400;

export class Section {
  constructor(place) {
    this.place = place;
    this.canvas = document.createElement("canvas");
    place.append(this.canvas);
    this.context = this.canvas.getContext("2d");
    new ResizeObserver(() => this.resize()).observe(place);
    this.stale = true;
    this.window = null;
    this.ratio = 0; // until its size is known: a tab in the background draws before that
  }

  prepare(hello, names, colours) {
    this.palate = hello.palate;
    this.names = names;
    this.colours = colours;
    this.window = null;
    this.last = null;
    this.stale = true;
  }

  /** The part of the plane that is shown: all that this tongue can be expected to reach. */
  frame(tongue, contour, mean, sigma) {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    const widen = (points) => {
      for (const [, y, z] of points) {
        low[0] = Math.min(low[0], y);
        low[1] = Math.min(low[1], z);
        high[0] = Math.max(high[0], y);
        high[1] = Math.max(high[1], z);
      }
    };
    mean.forEach((_, k) => {
      for (const sign of [-2, 2]) {
        const weights = mean.map((value, i) => (i === k ? value + sign * sigma[i] : value));
        widen(tongue.points(contour, { vertices: null, weights }));
      }
    });
    if (this.palate) widen(this.palate);
    this.window = { low: low.map((v) => v - MARGIN_MM), high: high.map((v) => v + MARGIN_MM) };
    this.stale = true;
  }

  theme(style) {
    const colour = (name) => style.getPropertyValue(name).trim();
    this.look = Object.fromEntries(
      ["ink", "quiet", "grid", "tissue", "tissue-soft", "palate", "ghost", "sheet"].map((name) => [name, colour(`--${name}`)]),
    );
    this.stale = true;
  }

  resize() {
    const ratio = Math.min(devicePixelRatio, 2);
    this.canvas.width = Math.round(this.place.clientWidth * ratio);
    this.canvas.height = Math.round(this.place.clientHeight * ratio);
    this.ratio = ratio;
    this.stale = true;
  }

  ghost(points) {
    this.ghostPoints = points;
    this.stale = true;
  }

  /** contour, vertices: [[x, y, z], ...] mm; trail: earlier poses, oldest first. */
  show(pose, contour, vertices, trail) {
    this.last = { pose, contour, vertices, trail };
    this.stale = true;
  }

  static get trailMs() {
    return TRAIL_MS;
  }

  draw() {
    if (!this.stale || !this.look || !this.window || !this.ratio || !this.canvas.width) return;
    this.stale = false;
    const pen = this.context, { low, high } = this.window;
    const width = this.canvas.width / this.ratio, height = this.canvas.height / this.ratio;
    const scale = Math.min(width / (high[0] - low[0]), height / (high[1] - low[1]));
    const left = (width - scale * (high[0] - low[0])) / 2, bottom = (height + scale * (high[1] - low[1])) / 2;
    this.at = ([, y, z]) => [left + scale * (y - low[0]), bottom - scale * (z - low[1])];
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = pen.lineCap = "round";
    this.grid(width, height, scale, left, bottom);
    if (this.palate) this.line(this.palate, this.look.palate, 4);
    if (this.ghostPoints) {
      pen.setLineDash([7, 6]);
      this.line(this.ghostPoints, this.look.ghost, 2.5);
      pen.setLineDash([]);
    }
    if (!this.last) return;
    this.flesh(this.last.contour, height);
    this.line(this.last.contour, this.look.tissue, 4);
    this.coils(width);
  }

  grid(width, height, scale, left, bottom) {
    const pen = this.context, { low } = this.window;
    pen.strokeStyle = this.look.grid;
    pen.lineWidth = 1;
    pen.beginPath();
    for (let y = Math.ceil((low[0] - left / scale) / 10) * 10; left + scale * (y - low[0]) < width; y += 10) {
      const x = Math.round(left + scale * (y - low[0])) + 0.5;
      pen.moveTo(x, 0);
      pen.lineTo(x, height);
    }
    for (let z = Math.ceil((low[1] - (height - bottom) / scale) / 10) * 10; bottom - scale * (z - low[1]) > 0; z += 10) {
      const y = Math.round(bottom - scale * (z - low[1])) + 0.5;
      pen.moveTo(0, y);
      pen.lineTo(width, y);
    }
    pen.stroke();
    pen.fillStyle = this.look.quiet;
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "alphabetic";
    pen.textAlign = "left";
    pen.fillText("◂ front", 10, 18);
    pen.textAlign = "right";
    pen.fillText("back ▸", width - 10, 18);
    pen.fillRect(width - 12 - 10 * scale, height - 14, 10 * scale, 3);
    pen.fillText("10 mm", width - 12, height - 20);
  }

  line(points, colour, thickness) {
    const pen = this.context;
    pen.strokeStyle = colour;
    pen.lineWidth = thickness;
    pen.beginPath();
    for (const point of points) pen.lineTo(...this.at(point));
    pen.stroke();
  }

  /** What is below the surface, fading out. */
  flesh(points, height) {
    const pen = this.context, placed = points.map((point) => this.at(point));
    const top = Math.min(...placed.map(([, y]) => y));
    const fade = pen.createLinearGradient(0, top, 0, height);
    fade.addColorStop(0, this.look["tissue-soft"]);
    fade.addColorStop(1, "transparent");
    pen.fillStyle = fade;
    pen.beginPath();
    for (const [x, y] of placed) pen.lineTo(x, y);
    pen.lineTo(placed.at(-1)[0], height);
    pen.lineTo(placed[0][0], height);
    pen.fill();
  }

  coils(width) {
    const pen = this.context, { pose, vertices, trail } = this.last;
    pen.font = "600 12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    this.names.forEach((name, i) => {
      const place = (other) => {
        const point = other.coils.subarray(3 * i, 3 * i + 3);
        return Number.isFinite(point[0]) ? this.at(point) : null;
      };
      const now = place(pose);
      if (!now) return;
      pen.strokeStyle = this.colours[i];
      pen.globalAlpha = 0.45;
      pen.lineWidth = 2;
      pen.beginPath();
      let broken = true;
      for (const other of trail) {
        const at = place(other);
        if (at) broken ? pen.moveTo(...at) : pen.lineTo(...at);
        broken = !at;
      }
      pen.stroke();
      pen.globalAlpha = 1;
      pen.strokeStyle = this.look.ink;
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.moveTo(...now);
      pen.lineTo(...this.at(vertices[i]));
      pen.stroke();
      pen.globalAlpha = pose.states[i] ? 0.4 : 1;
      pen.fillStyle = this.colours[i];
      pen.strokeStyle = this.look.sheet;
      pen.beginPath();
      pen.arc(...now, 6, 0, 7);
      pen.fill();
      pen.stroke();
      pen.fillStyle = this.look.ink;
      const right = now[0] + 12 + pen.measureText(name).width > width;
      pen.textAlign = right ? "right" : "left";
      pen.fillText(name, now[0] + (right ? -11 : 11), now[1] - 12);
      pen.globalAlpha = 1;
    });
  }
}
