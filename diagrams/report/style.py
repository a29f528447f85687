"""The style sheet of a report, for the screen and for paper."""

STYLE = """\
:root { --ink: #1f2933; --soft: #5b6875; --line: #d5dbe1; --band: #f4f6f8; --link: #0b5394; }
* { box-sizing: border-box; }
html { background: #fff; color: var(--ink); scroll-behavior: smooth; }
body { margin: 0 auto; padding: 0 1.5rem 4rem; max-width: 84rem; font: 15px/1.5 system-ui, "Segoe UI", Roboto,
  "Helvetica Neue", Arial, "Liberation Sans", "DejaVu Sans", sans-serif; display: grid;
  grid-template-columns: 15rem minmax(0, 1fr); column-gap: 2.5rem; }
header { grid-column: 1 / -1; border-bottom: 2px solid var(--ink); margin-bottom: 1.5rem; padding: 2rem 0 1rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .75rem; }
h2 { font-size: 1.4rem; line-height: 1.25; margin: 2.5rem 0 .75rem; border-bottom: 1px solid var(--line);
  padding-bottom: .25rem; }
h3 { font-size: 1.12rem; margin: 1.75rem 0 .5rem; }
h4 { font-size: 1rem; margin: 1.25rem 0 .4rem; }
section.level2:first-child h2 { margin-top: 0; }
p, ul { margin: .5rem 0 .75rem; max-width: 46rem; }
.no { color: var(--soft); font-weight: 400; margin-right: .35em; font-variant-numeric: tabular-nums; }
code, .path { font-family: ui-monospace, "SF Mono", Consolas, "Liberation Mono", "DejaVu Sans Mono", monospace;
  font-size: .88em; }
p code { white-space: nowrap; }
a { color: var(--link); text-decoration: none; }
a:hover { text-decoration: underline; }
a.n { color: inherit; text-decoration: underline dotted var(--line); text-underline-offset: .2em; }
a.n:hover { color: var(--link); text-decoration-color: var(--link); }
table.about { font-size: .87rem; }
table.about th { color: var(--soft); white-space: nowrap; vertical-align: baseline; }
table.about td { overflow-wrap: break-word; }
table.about th, table.about td { padding: .08rem 1rem .08rem 0; }
table.about tbody tr, table.about tbody tr:last-child { border: 0; }
nav { position: sticky; top: 0; align-self: start; max-height: 100vh; overflow-y: auto; padding: .5rem 0;
  font-size: .87rem; line-height: 1.35; }
nav h2 { font-size: .87rem; border: 0; margin: 0 0 .4rem; text-transform: uppercase; letter-spacing: .06em;
  color: var(--soft); }
nav ol { list-style: none; margin: 0; padding: 0; }
nav ol ol { padding-left: 1rem; }
nav li { margin: .3rem 0; }
nav a { color: var(--ink); }
main { min-width: 0; }
.table { margin: 1.25rem 0; overflow-x: auto; }
table { min-width: 18em; border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums lining-nums; }
caption { text-align: left; padding-bottom: .4rem; caption-side: top; }
th, td { padding: .28rem .75rem; text-align: left; vertical-align: baseline; }
th:first-child, td:first-child { padding-left: .35rem; }
thead th { border-top: 1.5px solid var(--ink); border-bottom: 1px solid var(--ink); font-weight: 600;
  vertical-align: bottom; }
tbody th { font-weight: 400; }
tbody tr { border-bottom: 1px solid var(--line); }
tbody tr:last-child { border-bottom: 1.5px solid var(--ink); }
tbody tr:hover { background: var(--band); }
tbody td { overflow-wrap: break-word; }
.right { text-align: right; white-space: nowrap; }
thead th.right { white-space: normal; }
td.again, th.again { color: #9aa5b1; }
.unit { color: var(--soft); font-weight: 400; white-space: nowrap; }
sup { color: var(--soft); font-size: .7em; font-style: italic; line-height: 0; margin-left: .3em; }
.right sup { display: inline-block; width: .9em; text-align: left; }
.note { font-size: .8rem; line-height: 1.45; color: var(--soft); margin: .4rem 0 0; }
table.dense { font-size: .82rem; }
table.dense th, table.dense td { padding: .2rem .5rem; }
table.numbers { width: 100%; }
.path { overflow-wrap: anywhere; }
tr:target, li:target { background: #fff6d6; }
figure { margin: 1.5rem 0; }
figure .scroll { overflow-x: auto; }
figure svg { max-width: 100%; height: auto; display: block; }
figure .wide svg { width: 100%; min-width: 56rem; }
figure .paper { display: none; }
figcaption { font-size: .9rem; margin-top: .5rem; max-width: 52rem; }
ol.why { font-size: .87rem; padding-left: 2rem; }
table.definitions th { white-space: nowrap; padding-right: 1.5rem; }
table.definitions td { max-width: 46rem; }
@media screen and (max-width: 60rem) {
  body { display: block; padding: 0 1rem 3rem; }
  nav { position: static; max-height: none; margin-bottom: 2rem; }
}
@page { size: A4; margin: 18mm 17mm 18mm 20mm;
  @bottom-right { content: counter(page); font-size: 8pt; color: #5b6875; } }
@media print {
  html { scroll-behavior: auto; }
  body { display: block; max-width: none; padding: 0; font-size: 8.5pt; line-height: 1.38; }
  header { padding: 0 0 8pt; margin: 0 0 12pt; }
  header table.about, nav, table, figcaption { font-size: 7.5pt; }
  h1 { font-size: 17pt; }
  h2 { font-size: 12.5pt; margin: 16pt 0 5pt; }
  h3 { font-size: 10pt; margin: 11pt 0 4pt; }
  h4 { font-size: 9pt; margin: 9pt 0 3pt; }
  section.level2:first-child h2 { margin-top: 18pt; }
  h2, h3, h4, caption { break-after: avoid; }
  h2, h3, h4 { break-inside: avoid; }
  /* room for what follows, taken back: no heading and no table's head stays alone where break-after is not known */
  h3::after, h4::after { content: ""; display: block; height: 60pt; margin-bottom: -60pt; }
  main h2::after, .long::before { content: ""; display: block; height: 90pt; margin-bottom: -90pt;
    break-inside: avoid; }
  nav { position: static; max-height: none; overflow: visible; }
  nav li { margin: 1.5pt 0; }
  nav a, a, a.n { color: inherit; text-decoration: none; }
  p, ul, figcaption { max-width: none; orphans: 3; widows: 3; }
  .table, figure .scroll { overflow: visible; }
  .table { margin: 9pt 0; }
  table { max-width: 100%; }
  table.dense { font-size: 6.5pt; }
  th, td { padding: 1.2pt 4pt; }
  table.dense th, table.dense td { padding: .9pt 3pt; }
  thead { display: table-header-group; }
  tr, figure, ol.why li, .keep { break-inside: avoid; }
  .table:not(.long) { break-inside: avoid; }
  .note, ol.why { font-size: 6.5pt; }
  table.numbers { font-size: 6pt; }
  table.numbers th, table.numbers td { padding: .35pt 3pt; }
  figure { margin: 9pt 0; }
  figure svg { max-width: 85%; max-height: 225mm; height: auto; }
  figure .wide { display: none; }
  figure .paper { display: block; }
  figure .paper svg { max-height: 225mm; width: auto; }
  tr:target, li:target, tbody tr:hover { background: none; }
}
"""
