// The diagram and its plants: the module, and the parameters that the page moves.

const CHUNK = 1024;  // ticks of a call, at most

class Model {
  constructor(bytes) {
    const math = {};
    for (const name of Object.getOwnPropertyNames(Math)) if (typeof Math[name] === 'function') math[name] = Math[name];
    this.calls = new WebAssembly.Instance(new WebAssembly.Module(bytes), { math }).exports;
    this.width = data.columns.length + 1;
    this.changed = new Map();
    this.reset();
  }
  reset() {
    this.calls.fill();
    for (const [place, value] of this.changed) this.put(place, value);
    this.calls.renew();
    this.calls.begin();
    this.isNew = false;
  }
  get failed() { return this.calls.failed() !== 0; }
  numbers(address, count) { return new Float64Array(this.calls.memory.buffer, address, count); }
  set(place, value) {
    this.changed.set(place, value);
    this.put(place, value);
    this.isNew = true;
  }
  put(place, value) { this.numbers(this.calls.parameters())[place] = value; }
  run(count, until, record) {  // returns the number of ticks that were gone through, up to a time
    if (this.isNew) { this.calls.renew(); this.isNew = false; }
    let done = 0;
    for (let n = 1; n > 0 && done < count && !this.failed;) {
      n = this.calls.run(Math.min(CHUNK, count - done), until);
      record.add(this.numbers(this.calls.samples(), n * this.width), n);
      done += n;
    }
    return done;
  }
  reason(t) {
    const when = `after t = ${short(t, 9)} s`, plant = this.calls.plant(), event = this.calls.event(), guard = this.calls.guard();
    if (plant >= 0) return `${data.plants[plant]} can't continue ${when}: a value of it is not finite, or out of its range.`;
    if (event >= data.events.length) return `the solver finds no step ${when}; a stiff diagram needs solver="Radau".`;
    if (event >= 0) return `${data.events[event].join('.')} fires without end ${when}.`;
    if (guard >= 0) return `${data.guards[guard].join('.')} is not positive ${when}: the equations of this block are not valid there.`;
    const log = this.numbers(this.calls.signals());
    for (const [block, port, first, count] of data.labels)
      for (let i = first; i < first + count; i++)
        if (!Number.isFinite(log[i])) return `${block}.${port} is not finite ${when}.`;
    return `not all values can be computed ${when}; an algebraic loop may have no solution there.`;
  }
}
