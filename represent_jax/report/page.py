"""The style sheet of the report's page."""

STYLE = """
:root { color-scheme: light; --ink: #1f2933; --muted: #5d6975; --line: #e3e7eb;
  --good: #1d7f46; --fair: #9a6700; --poor: #b42336; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f6f8; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
header p { margin: 0; color: var(--muted); font-size: .92rem; }
h1 { margin: .1rem 0 .6rem; font-size: clamp(1.6rem, 5vw, 2.3rem); line-height: 1.15;
  overflow-wrap: anywhere; }
h2 { margin: 0 0 .8rem; font-size: 1.2rem; }
.facts { display: flex; flex-wrap: wrap; gap: .4rem; margin: 0; padding: 0; list-style: none; }
.facts li { background: #fff; border: 1px solid var(--line); border-radius: 999px;
  padding: .12rem .75rem; font-size: .9rem; }
.facts span { color: var(--muted); }
section, details { background: #fff; border: 1px solid var(--line); border-radius: 12px;
  padding: 1.2rem 1.2rem 1.1rem; margin-top: 1.1rem; }
.notice { background: #fff8e1; border: 1px solid #f0dca0; border-radius: 12px;
  padding: .7rem 1rem; margin: 1.1rem 0 0; }
.cards { display: grid; gap: .8rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 330px), 1fr)); }
.card { border: 1px solid var(--line); border-left: 5px solid; border-radius: 8px;
  padding: .75rem .9rem; }
.card h3 { display: flex; justify-content: space-between; align-items: start; gap: .6rem;
  margin: 0; font-size: 1rem; line-height: 1.3; }
.card b { border-radius: 999px; padding: .12rem .6rem; color: #fff; font-size: .78rem;
  font-weight: 600; }
.card p { margin: .4rem 0 .3rem; font-size: .94rem; }
.card ul { margin: 0; padding: 0; list-style: none; color: var(--muted); font-size: .86rem; }
.good { border-left-color: var(--good); } .good b { background: var(--good); }
.fair { border-left-color: var(--fair); } .fair b { background: var(--fair); }
.poor { border-left-color: var(--poor); } .poor b { background: var(--poor); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .95rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: .42rem .7rem; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--line); }
th:first-child { text-align: left; padding-left: 0; }
thead th { color: var(--muted); font-weight: 500; font-size: .88rem; }
tbody th { font-weight: 600; }
tbody tr:last-child > * { border-bottom: 0; }
.note { margin: .8rem 0 0; color: var(--muted); font-size: .9rem; max-width: 96ch; }
.note b { color: var(--ink); }
.gallery { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 310px), 1fr)); }
.gallery img { width: 100%; max-width: 460px; height: auto; display: block; margin: 0 auto; }
.times td:nth-child(2) { width: 1%; }
.times th { width: 1%; }
.times .bar { padding-right: 0; }
.bar i { display: block; height: .7rem; min-width: 2px; border-radius: 3px; background: #7f96b2; }
summary { cursor: pointer; font-weight: 600; }
details .scroll { margin-top: .8rem; }
.pairs { font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; font-size: .84rem; }
.pairs th, .pairs td { text-align: left; font-weight: 400; padding-left: 0; white-space: normal;
  overflow-wrap: anywhere; }
.pairs th { color: var(--muted); width: 45%; }
"""
