for (const root of document.querySelectorAll('.lw-live:not([data-ready])')) {
  root.dataset.ready = '1';
  const data = JSON.parse(root.querySelector('script[type="application/json"]').textContent);
  const part = kind => root.querySelector('.lw-' + kind);
  const view = part('view'), panel = part('panel'), bar = part('bar'), find = root.querySelector('input');
  const colours = ['#228be6', '#e8590c', '#2f9e44', '#ae3ec9', '#0c8599', '#e64980'];
  let open = data.open, chosen = null;
  bar.hidden = !data.views.length;

  const make = (tag, text) => { const e = document.createElement(tag); e.textContent = text ?? ''; return e; };
  const above = path => data.subsystems.filter(s => path.startsWith(s + '.'));
  const owner = path => path.includes('.') ? path.slice(0, path.lastIndexOf('.')) : '';

  function show(wanted) {  // the nearest view that there is
    let best = null, least = Infinity;
    for (const v of data.views) {
      const apart = v.open.filter(s => !wanted.includes(s)).length + wanted.filter(s => !v.open.includes(s)).length;
      if (apart < least) { best = v; least = apart; }
    }
    open = best.open;
    view.innerHTML = best.svg;
    prepare();
    mark();
  }
  function prepare() {
    for (const wire of view.querySelectorAll('[data-signal] .lw-wire')) {  // wider, for the pointer
      const near = wire.cloneNode();
      near.classList.add('lw-near');
      wire.after(near);
    }
    for (const e of view.querySelectorAll('[data-block], [data-subsystem], [data-signal]')) {
      e.tabIndex = 0;
      e.onclick = event => { event.stopPropagation(); act(e); };
      e.onkeydown = event => { if (event.key === 'Enter' || event.key === ' ') { event.preventDefault(); act(e); } };
    }
  }
  function act(e) {
    const s = e.dataset.subsystem;
    if (s === undefined) { choose(e.dataset.block !== undefined ? ['blocks', e.dataset.block] : ['signals', e.dataset.signal]); return; }
    if (!data.views.length) return;
    show(open.includes(s) ? open.filter(o => o !== s && !o.startsWith(s + '.')) : [...open, s, ...above(s)]);
    const again = [...view.querySelectorAll('[data-subsystem]')].find(o => o.dataset.subsystem === s);
    if (again) again.focus();
  }
  function choose(what) { chosen = what; mark(); describe(); }
  function mark() {
    for (const e of view.querySelectorAll('.lw-found')) e.classList.remove('lw-found');
    if (!chosen) return;
    const key = chosen[0] === 'blocks' ? 'block' : 'signal';
    for (const e of view.querySelectorAll(`[data-${key}]`)) if (e.dataset[key] === chosen[1]) e.classList.add('lw-found');
  }
  function describe() {
    const [kind, path] = chosen, of = data[kind][path];
    panel.replaceChildren();
    panel.hidden = !of;
    if (!of) return;
    const head = make('h4', of.title);
    panel.append(head);
    if (of.about) panel.append(make('p', of.about));
    const list = make('dl');
    for (const [name, value] of of.facts) list.append(make('dt', name), make('dd', value));
    panel.append(list);
    if (of.curves) panel.append(plot(of));
  }
  function plot(of) {
    const ns = 'http://www.w3.org/2000/svg', svg = document.createElementNS(ns, 'svg');
    svg.setAttribute('viewBox', '-4 -4 408 98');
    svg.setAttribute('width', '400');
    svg.style.maxWidth = '100%';
    of.curves.forEach((points, i) => {
      const p = document.createElementNS(ns, 'polyline');
      p.setAttribute('points', points);
      p.style.stroke = colours[i % colours.length];
      svg.append(p);
    });
    return svg;
  }
  function search() {
    const text = find.value.trim().toLowerCase();
    if (!text) { chosen = null; mark(); panel.hidden = true; return; }
    const entries = ['blocks', 'signals'].flatMap(kind => Object.entries(data[kind]).map(([path, of]) => [kind, path, of]));
    const rank = ([, path, of]) => { const names = [path, ...(of.names ?? [])].map(n => n.toLowerCase());
      return names.some(n => n === text || n.endsWith('.' + text)) ? 0 : names.some(n => n.includes(text)) ? 1 : 2; };
    const hit = entries.map(e => [rank(e), e]).filter(([r]) => r < 2).sort((a, b) => a[0] - b[0])[0];
    if (!hit) { chosen = null; mark(); panel.replaceChildren(make('p', `nothing is called ${find.value}`)); panel.hidden = false; return; }
    const [kind, path] = hit[1];
    const home = kind === 'blocks' ? path : owner(path);
    const needed = above(home);
    if (data.views.length && needed.some(s => !open.includes(s))) show([...new Set([...open, ...needed])]);
    choose([kind, path]);
  }
  for (const b of bar.querySelectorAll('button')) b.onclick = () => show(b.dataset.all === 'open' ? data.subsystems : []);
  for (const b of bar.querySelectorAll('button')) b.hidden = !data.subsystems.length;
  find.oninput = search;
  bar.hidden = false;
  prepare();
}
