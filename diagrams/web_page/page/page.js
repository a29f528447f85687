// The page: running at the pace of the clock, buttons and keys, and the notebook that may be around it.

const LONGEST = 0.25;   // s of the clock that are caught up after a delay; a longer one is given up
const BUDGET = 0.012;   // s of a picture that may be spent in ticks; half of the time since the last one if that is more
const JUDGED = 1;       // s over which the speed that is reached is measured
const BRIEFLY = 5;      // s that a message is shown of what is over
const SENT_EVERY = 400; // ms between two messages to a notebook

const model = new Model(Uint8Array.from(atob($('lw-module').textContent.trim()), c => c.charCodeAt(0)));
const record = new Recording(model.width), sliders = new Map(), moved = new Map();  // values that were set, by name
const plots = data.plots.map(of => new Plot(of, record)), calm = matchMedia('(prefers-reduced-motion: reduce)');
let speed = data.speed, span = data.span, ticksDone = 0, drawn = false, scene = null;
let origin = 0, base = 0, before = 0;          // the clock and the time from which it runs, and the last picture
let behind = 0, judged = 0, judgedAt = 0;      // s that were given up, and where the judged stretch begins
let outOfSight = 0, clockReadAt = 0, saidUntil = Infinity;

for (const group of data.groups) {
  const box = document.createElement('section');
  box.className = 'group';
  if (group.title) box.append(Object.assign(document.createElement('h2'), { textContent: group.title }));
  for (const of of group.sliders) sliders.set(of.name, new Slider(of, box));
  $('sliders').append(box);
}

function say(text, seconds = Infinity) {  // for so many seconds of the clock
  saidUntil = performance.now() / 1000 + seconds;
  if ($('note').textContent !== text) $('note').textContent = text;
  $('note').hidden = !text;
}
function time() { return record.count ? record.time(record.count - 1) : 0; }
function move(name, place, value) {
  moved.set(name, value);
  record.change(name, value);
  model.set(place, value);
  if (model.failed && running) end();
}

// ---- running at the pace of the clock ----

function advance(count, until = Infinity) {  // so many ticks, up to a time, at once
  const done = model.run(count, until, record);
  ticksDone += done;
  if (model.failed) end();
  redraw();
  return done;
}
function end() {
  pause();
  say(`It has ended: ${model.reason(time())} Change what led there, and reset.`);
}
function frame(now) {
  now /= 1000;
  const gap = now - before;
  before = now;
  if (running && !document.hidden) keepPace(now, gap);
  if (now > saidUntil) say('');
  if (!drawn) draw(now * 1000);
  else if (scene && scene.moves && !calm.matches) drawScene(now * 1000);
  requestAnimationFrame(frame);
}
function keepPace(now, gap) {
  if (gap > LONGEST) {  // no pictures: the browser was busy, or the page was out of sight
    giveUp(gap, now, `The browser held the page up for ${short(gap, 2)} s; the run has waited.`);
    return;
  }
  const until = base + (now - origin) * speed, started = performance.now() / 1000, budget = Math.max(BUDGET, gap / 2);
  let done = 64, spent = 0;
  while (done === 64 && running && spent < budget) {
    done = advance(64, until);
    spent = performance.now() / 1000 - started;
  }
  const late = done === 64 ? (until - time()) / speed : 0;
  if (late > LONGEST) giveUp(late, now);
  if (now - judgedAt > JUDGED) judge(now);
  drawn = false;
}
function giveUp(lost, now, why = '') {
  behind += lost;
  origin = now; base = time();
  if (why) { say(why, BRIEFLY); startJudging(now); }
}
function startJudging(now) { judged = time(); judgedAt = now; }
function judge(now) {
  const reached = (time() - judged) / (now - judgedAt), slow = reached < 0.95 * speed && speed * (now - judgedAt) > 4 * data.step;
  startJudging(now);
  if (slow) say(`Slower than asked for: ${short(reached, 2)} × real time instead of ${short(speed)} ×, ${short(behind, 2)} s behind in all. Choose a lower speed.`);
  else if ($('note').textContent.startsWith('Slower')) say(behind ? `${short(behind, 2)} s behind the clock in all.` : '');
}
function start(now = performance.now() / 1000) { origin = before = now; base = time(); startJudging(now); }
function play() {
  if (model.failed) return;
  running = true; start();
  $('play').textContent = 'Pause';
}
function pause() { running = false; $('play').textContent = 'Run'; redraw(); }
function reset() {
  model.reset(); record.clear(); ticksDone = 0; behind = 0; start(); say('');
  for (const [name, value] of moved) record.change(name, value);
  for (const plot of plots) plot.restart();
  if (scene && scene.reset) scene.reset();
  if (model.failed) { pause(); say(`It can't begin: ${model.reason(0)} Change what led there, and reset.`); } else advance(1);
  notebook.restart();
  redraw();
}
function redraw() { drawn = false; }
function draw(now = performance.now()) {
  drawn = true;
  const t = time();
  if (!running || now - clockReadAt > READ_EVERY) {
    $('time').textContent = t.toFixed(data.step < 0.01 ? 2 : data.step < 1 ? 1 : 0);
    clockReadAt = now;
  }
  if (scene) drawScene(now);
  for (const plot of plots) if (!hidden.has(plot.canvas)) plot.draw(now, t, span, calm.matches);
  notebook.send(now);
}
function drawScene(now) { if (!hidden.has($('scene').firstChild)) scene.draw(now, calm.matches); }
function save() {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([record.csv()], { type: 'text/csv' }));
  link.download = `${data.name}.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// ---- a notebook around the page takes the record, if it asks for it ----

const notebook = {
  to: null, run: 0, sent: 0, told: 0, last: 0,
  restart() { this.run += 1; this.sent = this.told = 0; this.last = 0; },
  begin() { this.restart(); redraw(); },
  send(now) {
    if (!this.to || (running && now - this.last < SENT_EVERY)) return;
    const first = Math.max(this.sent, record.dropped), until = record.dropped + record.count, changes = record.changes.slice(this.told);
    if (first === until && !changes.length) return;
    const rows = record.rows.slice((first - record.dropped) * record.width, record.count * record.width);
    this.to.postMessage({ loopwright: data.key, view: data.view, run: this.run, first, count: until - first, changes, message: $('note').textContent, rows: rows.buffer }, '*', [rows.buffer]);
    this.last = now; this.sent = until; this.told = Math.max(0, record.changes.length - 1);  // the last one may still change
  },
};
if (data.key && window.parent !== window) {
  data.view = Math.random().toString(36).slice(2);
  window.addEventListener('message', event => {
    if (event.source === window.parent && event.data && event.data.loopwright === data.key && event.data.attach) { notebook.to = event.source; notebook.begin(); }
  });
  window.parent.postMessage({ loopwright: data.key, ready: true }, '*');
}

// ---- buttons and keys ----

$('play').onclick = () => running ? pause() : play();
$('step').onclick = () => { pause(); if (!model.failed) advance(1); };
$('reset').onclick = reset;
$('save').onclick = save;
$('speed').onchange = event => { speed = Number(event.target.value); behind = 0; if (!model.failed) say(''); start(); };
$('span').onchange = event => { span = Number(event.target.value); redraw(); };
document.onkeydown = event => {
  if (event.target.closest('input, select, button, summary') || event.ctrlKey || event.metaKey || event.altKey) return;
  const act = { ' ': () => running ? pause() : play(), ArrowRight: () => { pause(); if (!model.failed) advance(event.shiftKey ? 100 : 1); }, r: reset }[event.key];
  if (act) { event.preventDefault(); act(); }
};
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => { readColours(); redraw(); });
document.onvisibilitychange = () => {  // no pictures and no ticks out of sight
  const now = performance.now() / 1000;
  if (document.hidden) { outOfSight = now; return; }
  if (running) { say(`The page was out of sight for ${short(now - outOfSight, 2)} s; the run has waited.`, BRIEFLY); start(now); }
};

readColours();
$('step').title = `one tick of ${short(data.step)} s`;
for (const name of ['speed', 'span']) $(name).value = String(data[name]);
window.page = {  // for scenes, scripts and tests
  data, record, sliders, fit, short, advance, play, pause, reset, redraw, draw, model, colours,
  get time() { return time(); }, get running() { return running; }, get behind() { return behind; }, get ticks() { return ticksDone; },
  now(name) { const i = data.columns.findIndex(c => c.name === name); return record.count ? record.value(record.count - 1, i) : 0; },
  set(name, value) { sliders.has(name) ? sliders.get(name).set(value) : move(name, data.hidden[name], value); },
};
if (window.makeScene) scene = window.makeScene(window.page, $('scene'));
reset();
requestAnimationFrame(frame);
