// Plots that scroll. Each keeps the smallest and the largest value of every pixel, and adds new samples alone.

const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];  // of the curves of a plot, in their order
const READ_EVERY = 100;                             // ms between two numbers that are shown while it runs

// ---- numbers and colours ----

function short(value, digits = 4) {
  if (!Number.isFinite(value)) return '–';
  const text = Math.abs(value) >= 1e5 || (value && Math.abs(value) < 1e-3) ? value.toExponential(Math.min(digits, 4) - 2) : String(Number(value.toPrecision(digits)));
  return text.replaceAll('-', '−');
}
const unitText = unit => unit.replaceAll('.', '·');
const tiny = value => Math.abs(value) < 1e-12 ? 0 : value;
const colours = {};
function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ['ink', 'soft', 'line', 'grid', 'page', 'band', 'accent', 'robot', 'robot-edge', 'warn', ...Array.from({ length: 6 }, (_, i) => `c${i}`)])
    colours[name] = style.getPropertyValue(`--${name}`).trim();
}
const curveColour = i => colours[`c${i % 6}`];

// ---- canvases: their sizes are kept, so that no picture asks for the layout ----

const sizes = new Map(), hidden = new Set();
const resized = new ResizeObserver(found => {
  for (const one of found) sizes.set(one.target, [one.contentRect.width, one.contentRect.height]);
  redraw();
});
const seen = new IntersectionObserver(found => {
  for (const one of found) if (one.isIntersecting) hidden.delete(one.target); else hidden.add(one.target);
  redraw();
}, { rootMargin: '100px' });
function fit(canvas) {  // the drawing context in CSS pixels, and the size
  if (!sizes.has(canvas)) {
    const box = canvas.getBoundingClientRect();
    sizes.set(canvas, [box.width, box.height]);
    resized.observe(canvas); seen.observe(canvas);
  }
  const ratio = window.devicePixelRatio || 1, [width, height] = sizes.get(canvas);
  const w = Math.round(width * ratio), h = Math.round(height * ratio);
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const ctx = canvas.getContext('2d');
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  return [ctx, width, height];
}

// ---- the values of each pixel ----

class Envelope {
  constructor(columns, record, span, bins) {
    Object.assign(this, { columns, record, span, bins, width: span / bins, size: bins + 2, newest: -Infinity, taken: 0 });
    this.least = columns.map(() => new Float64Array(this.size));
    this.most = columns.map(() => new Float64Array(this.size));
    this.last = columns.map(() => new Float64Array(this.size));
    this.skip(record.from((record.count ? record.time(record.count - 1) : 0) - span));
  }
  fits(record, span, bins) { return this.record === record && this.span === span && this.bins === bins && this.taken <= record.dropped + record.count; }
  skip(first) { this.taken = this.record.dropped + first; }
  take() {  // the samples that have come
    const { record, columns, size } = this;
    for (let i = Math.max(0, this.taken - record.dropped); i < record.count; i++) {
      const bin = Math.floor(record.time(i) / this.width);
      if (bin - this.newest > size) this.newest = bin - size;
      while (this.newest < bin) {
        const at = ++this.newest % size;
        for (let k = 0; k < columns.length; k++) { this.least[k][at] = Infinity; this.most[k][at] = -Infinity; }
      }
      const at = bin % size;
      for (let k = 0; k < columns.length; k++) {
        const v = record.value(i, columns[k]);
        if (v < this.least[k][at]) this.least[k][at] = v;
        if (v > this.most[k][at]) this.most[k][at] = v;
        this.last[k][at] = v;
      }
    }
    this.taken = record.dropped + record.count;
  }
  range(t0) {
    let low = Infinity, high = -Infinity;
    for (let bin = Math.max(0, Math.floor(t0 / this.width), this.newest - this.size + 1); bin <= this.newest; bin++)
      for (let k = 0; k < this.columns.length; k++) {
        if (this.least[k][bin % this.size] < low) low = this.least[k][bin % this.size];
        if (this.most[k][bin % this.size] > high) high = this.most[k][bin % this.size];
      }
    return [low, high];
  }
  trace(ctx, k, t0, x, y) {  // a line through the pixels: each from its smallest to its largest value
    const [least, most, last] = [this.least[k], this.most[k], this.last[k]];
    for (let bin = Math.max(0, Math.floor(t0 / this.width), this.newest - this.size + 1); bin <= this.newest; bin++) {
      const at = bin % this.size;
      if (!(least[at] <= most[at])) continue;
      const where = x((bin + 0.5) * this.width), low = y(least[at]), high = y(most[at]), end = y(last[at]);
      if (low - high > 0.6) {
        const rises = low - end > end - high;  // it ends near its largest value
        ctx.lineTo(where, rises ? low : high);
        ctx.lineTo(where, rises ? high : low);
        if (Math.abs(end - (rises ? high : low)) > 0.6) ctx.lineTo(where, end);
      } else ctx.lineTo(where, end);
    }
  }
}

// ---- plots ----

class Plot {
  constructor(of, record) {
    this.of = of; this.record = record;
    const box = document.createElement('figure');
    box.className = 'plot';
    const legend = document.createElement('figcaption');
    legend.className = 'legend';
    this.outputs = of.curves.map((curve, i) => {
      const key = document.createElement('span'), mark = document.createElement('i'), value = document.createElement('output');
      key.className = `key d${i % DASHES.length}`;
      key.style.setProperty('--curve', `var(--c${i % 6})`);
      const column = data.columns[curve];
      key.append(mark, `${column.label} `, value);
      key.title = column.name;
      legend.append(key);
      return value;
    });
    this.canvas = document.createElement('canvas');
    this.canvas.setAttribute('role', 'img');
    this.canvas.setAttribute('aria-label', `${of.curves.map(c => data.columns[c].label).join(', ')} over time`);
    this.canvas.onpointermove = this.canvas.onpointerdown = event => { cursor = event.offsetX; redraw(); };
    this.canvas.onpointerleave = () => { cursor = null; redraw(); };
    box.append(legend, this.canvas);
    $('plots').append(box);
    this.texts = []; this.read = 0;
    this.restart();
  }
  restart() { this.low = this.high = null; this.envelope = null; }
  timeAt(x) { return this.t0 + (x - this.left) / (this.w - this.left) * (this.t1 - this.t0); }
  scale(low, high) {  // whole steps of the axis: it moves when a curve leaves it, or fills less than a third of it
    if (!(low <= high)) { low = 0; high = 1; }
    const least = Math.max(Math.abs(low), Math.abs(high)) * 1e-6 || 1e-9;
    if (high - low < least) { const middle = (low + high) / 2, half = Math.max(least, 0.5 * Math.abs(middle) || 0.5); low = middle - half; high = middle + half; }
    if (this.low === null || low < this.low || high > this.high || high - low < 0.33 * (this.high - this.low)) {
      const size = stepOf(low, high, 4);
      this.low = Math.floor(low / size) * size;
      this.high = Math.ceil(high / size) * size;
    }
    const pad = 0.03 * (this.high - this.low);
    return [this.low - pad, this.high + pad];
  }
  draw(now, t, span, calm) {
    const [ctx, w, h] = fit(this.canvas), left = 54, bottom = h - 18, top = 6, record = this.record, curves = this.of.curves;
    if (w <= left) return;
    const page = calm ? span / 4 : 0;  // without motion it moves by a quarter of its width
    const t1 = Math.max(page ? Math.ceil(t / page) * page : t, span), t0 = t1 - span;
    Object.assign(this, { left, w, t0, t1 });
    const bins = Math.max(1, Math.round((w - left) * Math.min(2, window.devicePixelRatio || 1)));
    if (!this.envelope || !this.envelope.fits(record, span, bins)) this.envelope = new Envelope(curves, record, span, bins);
    this.envelope.take();
    const [y0, y1] = this.scale(...this.envelope.range(t0));
    const x = time => left + (time - t0) / span * (w - left), y = v => bottom - (v - y0) / (y1 - y0) * (bottom - top);
    ctx.clearRect(0, 0, w, h);
    this.drawGrid(ctx, x, y, [t0, t1, y0, y1], [left, w, top, bottom, h]);
    ctx.save();
    ctx.beginPath(); ctx.rect(left, 0, w - left, bottom + 1); ctx.clip();
    ctx.lineJoin = 'bevel'; ctx.lineWidth = 1.6;
    const n = record.count, first = Math.max(0, record.from(t0) - 1);
    for (let k = 0; k < curves.length; k++) {  // a curve is seen between the dashes of those above it
      ctx.strokeStyle = curveColour(k); ctx.setLineDash(DASHES[k % DASHES.length]); ctx.beginPath();
      if (n - first < 2 * bins) for (let i = first; i < n; i++) ctx.lineTo(x(record.time(i)), y(record.value(i, curves[k])));
      else this.envelope.trace(ctx, k, t0, x, y);
      ctx.stroke();
    }
    ctx.restore();
    let row = n - 1;
    if (cursor !== null && n) {
      const at = Math.max(left, Math.min(w, cursor));
      row = Math.max(0, Math.min(n - 1, record.from(this.timeAt(at))));
      ctx.strokeStyle = colours.soft; ctx.beginPath(); ctx.moveTo(at + 0.5, top); ctx.lineTo(at + 0.5, bottom); ctx.stroke();
    } else if (running && now - this.read < READ_EVERY) return;
    this.read = now;
    curves.forEach((curve, k) => {
      const text = n ? `${short(record.value(row, curve))} ${unitText(data.columns[curve].unit)}` : '';
      if (this.texts[k] !== text) this.outputs[k].textContent = this.texts[k] = text;
    });
  }
  drawGrid(ctx, x, y, [t0, t1, y0, y1], [left, w, top, bottom, h]) {
    ctx.font = '11px system-ui, sans-serif'; ctx.lineWidth = 1; ctx.strokeStyle = colours.grid; ctx.fillStyle = colours.soft;
    ctx.setLineDash([]); ctx.textAlign = 'right'; ctx.textBaseline = 'middle';
    const rows = ticks(y0, y1, Math.max(2, Math.floor((bottom - top) / 34))), columns = ticks(t0, t1, Math.max(2, Math.floor(w / 110)));
    ctx.beginPath();
    for (const v of rows) { const at = Math.round(y(v)) + 0.5; ctx.moveTo(left, at); ctx.lineTo(w, at); }
    for (const v of columns) { const at = Math.round(x(v)) + 0.5; if (at >= left) { ctx.moveTo(at, top); ctx.lineTo(at, bottom); } }
    ctx.stroke();
    for (const v of rows) ctx.fillText(short(tiny(v)), left - 6, Math.round(y(v)) + 0.5);
    ctx.textAlign = 'center'; ctx.textBaseline = 'alphabetic';
    for (const v of columns) if (x(v) >= left) ctx.fillText(`${short(tiny(v), 6)} s`, Math.min(x(v), w - 16), h - 4);
  }
}

function stepOf(low, high, count) {  // of the numbers at an axis, which has two at least
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const sizes = [0.2, 0.5, 1, 2, 5, 10].map(m => m * power), multiples = size => Math.floor(high / size) - Math.ceil(low / size) + 1;
  let i = sizes.findIndex(size => size >= rough);
  while (i > 0 && multiples(sizes[i]) < 2) i--;
  return sizes[i];
}
function ticks(low, high, count) {
  const size = stepOf(low, high, count), found = [];
  for (let k = Math.ceil(low / size); k * size <= high; k++) found.push(k * size);
  return found;
}
