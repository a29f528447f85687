// Sliders: a parameter each, by pointer, keys, or a number that is typed in.

class Slider {
  constructor(of, box) {
    this.of = of; this.value = of.value;
    const row = this.row = document.createElement('div'), id = `s${Slider.count = (Slider.count ?? 0) + 1}`;
    const make = (tag, parts) => Object.assign(document.createElement(tag), parts);
    row.className = 'slider';
    const label = make('label', { textContent: of.label, htmlFor: id, title: of.name });
    this.back = make('button', { textContent: '↺', className: 'back', title: `back to ${short(of.value, 6)}` });
    this.back.setAttribute('aria-label', `${of.label}: back to ${short(of.value, 6)} ${unitText(of.unit)}`.trim());
    this.number = make('input', { type: 'number', step: 'any', inputMode: 'decimal' });
    this.number.setAttribute('aria-label', `${of.label}, value`);
    const unit = make('span', { className: 'unit', textContent: unitText(of.unit) });
    this.range = make('input', { type: 'range', id, min: 0, max: 1, step: 0.001 });
    const back = () => this.set(of.value);
    this.range.oninput = () => this.set(this.rounded(this.unscaled(Number(this.range.value))), true);
    this.range.ondblclick = label.ondblclick = back;
    this.back.onclick = () => { back(); this.range.focus(); };
    this.range.onkeydown = event => {  // an arrow is a hundredth of the way, with Shift a thousandth
      const sign = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
      if (!sign || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      this.range.value = Number(this.range.value) + sign * (event.shiftKey ? 0.001 : 0.01);
      this.range.oninput();
    };
    this.number.onchange = () => {
      const v = Number(this.number.value);
      if (this.number.value !== '' && Number.isFinite(v)) this.set(Math.min(of.high, Math.max(of.low, v))); else this.show();
    };
    row.append(label, this.back, this.number, unit, this.range);
    box.append(row);
    this.show();
  }
  scaled(v) { const { low, high, log } = this.of; return log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low); }
  unscaled(s) { const { low, high, log } = this.of; return log ? low * (high / low) ** s : low + s * (high - low); }
  rounded(v) {  // three digits, of the range where that is not logarithmic: a slider near 0 is 0
    const { low, high, log } = this.of, unit = log ? 0 : 10 ** (Math.floor(Math.log10(high - low)) - 3);
    return Math.min(high, Math.max(low, Number((unit ? Math.round(v / unit) * unit : v).toPrecision(log ? 3 : 12)))) || 0;
  }
  show(byHand) {
    if (!byHand) this.range.value = this.scaled(this.value);
    this.range.style.setProperty('--at', this.range.value);
    this.number.value = Number(this.value.toPrecision(6));
    this.range.setAttribute('aria-valuetext', `${short(this.value, 6)} ${unitText(this.of.unit)}`.trim());
    this.row.classList.toggle('moved', this.value !== this.of.value);
  }
  set(value, byHand) {
    this.value = value;
    move(this.of.name, this.of.place, value);
    this.show(byHand);
    redraw();
  }
}
