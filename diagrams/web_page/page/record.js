// The record: rows of samples since the last reset, and what was moved.

const KEPT = 48e6;  // bytes of the record; then its oldest part is dropped

class Recording {
  constructor(width) { this.width = width; this.most = Math.floor(KEPT / 8 / width); this.clear(); }
  clear() { this.rows = new Float64Array(4096 * this.width); this.count = 0; this.dropped = 0; this.changes = []; }
  add(values, n) {
    if (!n) return;
    if ((this.count + n) * this.width > this.rows.length) {
      if (this.count + n > this.most) {
        const gone = Math.max(n, this.most >> 2);
        this.rows.copyWithin(0, gone * this.width, this.count * this.width);
        this.count -= gone; this.dropped += gone;
      }
      if ((this.count + n) * this.width > this.rows.length) {
        const larger = new Float64Array(Math.max(2 * this.rows.length, (this.count + n) * this.width));
        larger.set(this.rows);
        this.rows = larger;
      }
    }
    this.rows.set(values, this.count * this.width);
    this.count += n;
  }
  change(name, value) {  // it acts after the samples that there are
    const after = this.dropped + this.count, last = this.changes.findLast(one => one.after === after && one.name === name);
    if (last) last.value = value; else this.changes.push({ after, t: this.count ? this.time(this.count - 1) : null, name, value });
  }
  time(i) { return this.rows[i * this.width]; }
  value(i, column) { return this.rows[i * this.width + 1 + column]; }
  from(t) {  // the first sample at a time or later
    let low = 0, high = this.count;
    while (low < high) { const middle = (low + high) >> 1; if (this.time(middle) < t) low = middle + 1; else high = middle; }
    return low;
  }
  csv() {
    const quoted = name => /[",\r\n]/.test(name) ? `"${name.replaceAll('"', '""')}"` : name;
    const head = [{ name: 't', unit: 's' }, ...data.columns].map(c => quoted(c.unit ? `${c.name} [${c.unit}]` : c.name));
    const lines = [head.join(',')];
    for (let i = 0; i < this.count; i++)
      lines.push(Array.from(this.rows.subarray(i * this.width, (i + 1) * this.width)).join(','));
    return lines.join('\n') + '\n';
  }
}
