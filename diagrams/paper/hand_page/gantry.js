'use strict';
// The gantry from above, with its path, the pointer that pulls its tool, and the forces.
window.makeScene = (page, box) => {
  const { axes, path, limit } = page.data.scene, { size, span, sigma, tangent, normal, closed } = path;
  const canvas = document.createElement('canvas');
  canvas.style.height = 'clamp(272px, 42vw, 430px)';
  canvas.setAttribute('role', 'application');
  canvas.setAttribute('aria-label', 'the gantry from above, with its path; pull its tool with the pointer or the arrow keys');
  canvas.tabIndex = 0;
  box.append(canvas);
  const trailSeconds = 3, perNewton = 0.02;  // m of an arrow for each N
  const reach = 0.1;  // m from the tool to a hand that the keys move
  let held = false, hand = [0, 0], scale = 1, offset = [0, 0], touched = false;

  const toScreen = p => [offset[0] + p[0] * scale, offset[1] - p[1] * scale];
  const toWorld = e => { const at = canvas.getBoundingClientRect(); return [(e.clientX - at.left - offset[0]) / scale, (offset[1] - e.clientY + at.top) / scale]; };
  const tool = () => axes.map(page.now);

  function move(to) {
    hand = to;
    page.set('hand_y', hand[0]); page.set('hand_z', hand[1]);
    page.redraw();
  }
  function grip(to) {
    held = touched = true; canvas.classList.add('held');
    move(to); page.set('grip', 1);
    if (!page.running) page.play();
  }
  function letGo() {
    if (!held) return;
    held = false; canvas.classList.remove('held'); page.set('grip', 0); page.redraw();
  }
  canvas.onpointerdown = e => {
    e.preventDefault(); canvas.focus({ preventScroll: true });
    try { canvas.setPointerCapture(e.pointerId); } catch { /* a script's event has no pointer */ }
    grip(toWorld(e));
  };
  canvas.onpointermove = e => { if (held && !keys.size) move(toWorld(e)); };
  canvas.onpointerup = canvas.onpointercancel = letGo;
  const ways = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }, keys = new Set();
  function pullByKeys() {  // the hand is ahead of the tool, which it follows
    const to = tool();
    for (const key of keys) { to[0] += ways[key][0] * reach; to[1] += ways[key][1] * reach; }
    return to;
  }
  canvas.onkeydown = e => {
    if (!ways[e.key] || e.ctrlKey || e.metaKey || e.altKey) return;
    e.preventDefault(); e.stopPropagation();
    keys.add(e.key); grip(pullByKeys());
  };
  canvas.onkeyup = e => { if (keys.delete(e.key) && !keys.size) letGo(); };
  canvas.onblur = () => { if (keys.size) { keys.clear(); letGo(); } };

  function frameAt(theta) {  // point, tangent and normal of the path, between two samples of it
    let s = (theta - span[0]) / (span[1] - span[0]);
    s = closed ? s - Math.floor(s) : Math.min(1, Math.max(0, s));
    const i = Math.min(Math.floor(s * size), size - 1), f = s * size - i, j = i + 1;
    return [sigma, tangent, normal].map(v => [v[i][0] * (1 - f) + v[j][0] * f, v[i][1] * (1 - f) + v[j][1] * f]);
  }
  function arrow(ctx, from, to, colour, width) {
    const [x0, y0] = toScreen(from), [x1, y1] = toScreen(to), length = Math.hypot(x1 - x0, y1 - y0);
    if (length < 3) return;
    const ux = (x1 - x0) / length, uy = (y1 - y0) / length, head = Math.min(4 + 1.6 * width, length);
    ctx.strokeStyle = ctx.fillStyle = colour; ctx.lineWidth = width;
    ctx.beginPath(); ctx.moveTo(x0, y0); ctx.lineTo(x1 - ux * head * 0.8, y1 - uy * head * 0.8); ctx.stroke();
    ctx.beginPath(); ctx.moveTo(x1, y1);
    ctx.lineTo(x1 - ux * head - uy * head * 0.55, y1 - uy * head + ux * head * 0.55);
    ctx.lineTo(x1 - ux * head + uy * head * 0.55, y1 - uy * head - ux * head * 0.55); ctx.fill();
  }
  function spring(ctx, from, to) {
    const [x0, y0] = toScreen(from), [x1, y1] = toScreen(to), length = Math.hypot(x1 - x0, y1 - y0);
    if (length < 2) return;
    const ux = (x1 - x0) / length, uy = (y1 - y0) / length, turns = 12;
    ctx.beginPath(); ctx.moveTo(x0, y0);
    for (let k = 0; k <= turns; k++) {
      const s = length * (0.12 + 0.76 * k / turns), side = k === 0 || k === turns ? 0 : (k % 2 ? 5 : -5);
      ctx.lineTo(x0 + ux * s - uy * side, y0 + uy * s + ux * side);
    }
    ctx.lineTo(x1, y1); ctx.stroke();
  }
  function label(ctx, text, at, colour, align = 'left') {
    ctx.font = '600 12px system-ui, sans-serif'; ctx.textAlign = align; ctx.textBaseline = 'middle';
    ctx.lineWidth = 3.5; ctx.strokeStyle = page.colours.page; ctx.lineJoin = 'round';
    ctx.strokeText(text, at[0], at[1]); ctx.fillStyle = colour; ctx.fillText(text, at[0], at[1]);
  }
  function rounded(ctx, x, y, w, h, r) { ctx.beginPath(); ctx.roundRect(x, y, w, h, r); ctx.fill(); ctx.stroke(); }

  function draw(now = 0, calm = false) {
    if (keys.size && page.running) move(pullByKeys());
    const [ctx, w, h] = page.fit(canvas), c = page.colours;
    const ys = sigma.map(p => p[0]), zs = sigma.map(p => p[1]), room = 0.14;
    const low = [Math.min(...ys) - room, Math.min(...zs) - room], high = [Math.max(...ys) + room, Math.max(...zs) + room];
    scale = Math.min(w / (high[0] - low[0]), (h - 30) / (high[1] - low[1]));
    offset = [w / 2 - scale * (low[0] + high[0]) / 2, (h - 8) / 2 + scale * (low[1] + high[1]) / 2];
    ctx.clearRect(0, 0, w, h);
    const at = tool(), [x, y] = toScreen(at), theta = page.now('theta');
    const [foot, t, n] = frameAt(theta), force = [page.now('hand.force[1]'), page.now('hand.force[2]')];

    // the gantry: two rails, the beam on them, the carriage on the beam
    const top = 14, bottom = h - 34;
    ctx.fillStyle = c.band; ctx.strokeStyle = c.line; ctx.lineWidth = 1;
    for (const rail of [top, bottom]) rounded(ctx, 12, rail - 5, w - 24, 10, 4);
    ctx.fillStyle = c.robot; ctx.strokeStyle = c['robot-edge'];
    rounded(ctx, x - 9, top - 8, 18, bottom - top + 16, 5);
    rounded(ctx, x - 22, top - 10, 44, 20, 5);
    rounded(ctx, x - 22, bottom - 10, 44, 20, 5);

    ctx.strokeStyle = c.ink; ctx.lineWidth = 1.5; ctx.setLineDash([6, 4]); ctx.beginPath();
    sigma.forEach(p => ctx.lineTo(...toScreen(p)));
    ctx.stroke(); ctx.setLineDash([]);

    const record = page.record, first = record.from(page.time - trailSeconds), count = record.count - first;
    const [iy, iz] = axes.map(name => page.data.columns.findIndex(column => column.name === name));
    ctx.strokeStyle = c.c2; ctx.lineWidth = 2.2; ctx.lineCap = 'butt';
    const pieces = 30, step = Math.max(1, Math.floor(count / 240));
    for (let k = 0; k < pieces; k++) {
      const from = first + Math.floor(count * k / pieces), to = Math.min(record.count - 1, first + Math.floor(count * (k + 1) / pieces));
      ctx.globalAlpha = 0.05 + 0.75 * k / pieces; ctx.beginPath();
      for (let i = from; i < to; i += step) ctx.lineTo(...toScreen([record.value(i, iy), record.value(i, iz)]));
      if (to >= from) ctx.lineTo(...toScreen([record.value(to, iy), record.value(to, iz)]));
      ctx.stroke();
    }
    ctx.globalAlpha = 1;

    ctx.fillStyle = c.robot; ctx.strokeStyle = c['robot-edge']; ctx.lineWidth = 1.2;
    rounded(ctx, x - 17, y - 17, 34, 34, 7);
    ctx.strokeStyle = c.soft; ctx.lineWidth = 1; ctx.beginPath(); ctx.moveTo(...toScreen(foot)); ctx.lineTo(x, y); ctx.stroke();
    ctx.fillStyle = c.page; ctx.strokeStyle = c.ink; ctx.lineWidth = 1.2;
    ctx.beginPath(); ctx.arc(...toScreen(foot), 3.5, 0, 7); ctx.fill(); ctx.stroke();

    if (held) {
      ctx.strokeStyle = c.soft; ctx.lineWidth = 1.6; spring(ctx, at, hand);
      ctx.lineWidth = 2; ctx.fillStyle = c.page; ctx.beginPath(); ctx.arc(...toScreen(hand), 9, 0, 7); ctx.fill(); ctx.stroke();
    } else if (!touched) {  // an invitation
      const grown = calm ? 0 : 4 * Math.sin(now / 350);
      ctx.strokeStyle = c.accent; ctx.lineWidth = 2.5; ctx.setLineDash([5, 5]);
      ctx.beginPath(); ctx.arc(x, y, 32 + grown, 0, 7); ctx.stroke(); ctx.setLineDash([]);
      label(ctx, 'pull me', [x + 44, y - 20], c.accent);
    }
    const along = force[0] * t[0] + force[1] * t[1], across = force[0] * n[0] + force[1] * n[1], size = Math.hypot(...force);
    const tip = (v, f) => [at[0] + v[0] * f * perNewton, at[1] + v[1] * f * perNewton];
    arrow(ctx, at, tip(t, along), c.c0, 3);
    arrow(ctx, at, tip(n, across), c.c1, 3);
    const slanted = Math.min(Math.abs(along), Math.abs(across)) > 0.25 * size;
    if (slanted) arrow(ctx, at, tip(force, 1), c.ink, 3.4);
    ctx.fillStyle = c.ink; ctx.beginPath(); ctx.arc(x, y, 4.5, 0, 7); ctx.fill();
    const beside = (v, f, text, colour) => {
      const end = toScreen(tip(v, f)), dx = end[0] - x, dy = end[1] - y, far = Math.hypot(dx, dy);
      if (far > 14) label(ctx, text, [end[0] + 12 * dx / far, end[1] + 12 * dy / far], colour, dx < 0 ? 'right' : 'left');
    };
    const number = v => `${page.short(Math.round(v * 10) / 10, 2)} N`;
    beside(t, along, `along ${number(Math.abs(along))}`, c.c0);
    beside(n, across, `across ${number(Math.abs(across))}`, c.c1);
    if (slanted) beside(force, 1, number(size), c.ink);

    ctx.font = '12.5px system-ui, sans-serif'; ctx.textAlign = 'left'; ctx.textBaseline = 'alphabetic'; ctx.fillStyle = c.soft;
    ctx.fillText(`ξ ${page.short(Math.round(1e4 * page.now('xi[1]')) / 10, 3)} mm`, 14, h - 8);
    ctx.textAlign = 'right';
    if (size >= limit * 0.999) { ctx.fillStyle = c.warn; ctx.fillText(`the hand's largest force: ${page.short(limit)} N`, w - 14, h - 8); }
    else if (!touched) ctx.fillText('Press anywhere, and pull.', w - 14, h - 8);
  }
  return { draw, get moves() { return !touched; }, reset() { page.set('grip', held ? 1 : 0); if (held) move(hand); } };
};
