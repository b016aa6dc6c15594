// The page of `represent_jax.teleoperation`: shows what the server tells, tells it what is pressed.

// The server releases keys that it has not heard of for a second, and pauses after three.
const TOLD_AGAIN_MS = 250;
const RECONNECT_MS = 1000;
const DEGREES_PER_PIXEL = 0.35;
const CLOSER_PER_WHEEL = 0.0015;
const CAPS = {
  " ": "Space", arrowleft: "←", arrowright: "→", arrowup: "↑", arrowdown: "↓",
  shift: "Shift", control: "Ctrl", enter: "Enter", escape: "Esc", tab: "Tab", backspace: "⌫",
};
const PHASES = {
  ready: "ready", driving: "recording", paused: "paused", over: "episode over",
  playing: "playing",
};
const PRIMARY = {
  ready: ["Start", "start"], driving: ["Pause", "pause"], paused: ["Resume", "resume"],
  over: ["Start", ""], playing: ["Stop", "stop"],
};
const AGAIN = ["Again", "discard"];

const $ = (id) => document.getElementById(id);
const down = new Map(); // Name of each key that is held, by its place on the keyboard.
let socket = null;
let hello = { keys: {}, cameras: [] };
let role = { drives: false, free: false };
let status = null;
let recordedShown = -1;
let pictureUrl = "";

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function connect() {
  socket = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/live`);
  socket.binaryType = "blob";
  socket.onmessage = ({ data }) => {
    if (data instanceof Blob) return showPicture(data);
    const message = JSON.parse(data);
    ({ hello: hear, role: hearRole, status: hearStatus, problem: hearProblem })[message.kind](
      message,
    );
  };
  socket.onclose = () => {
    release();
    role = { drives: false, free: false };
    status = null;
    $("role").textContent = "connection lost";
    $("role").className = "badge lost";
    showProblem("The server has ended or the connection broke. What was saved is in the file; " +
      "an episode that was not saved waits, paused, as long as the server runs. Reconnecting …");
    showControls();
    setTimeout(connect, RECONNECT_MS);
  };
}

function hear(message) {
  hello = message;
  recordedShown = -1;
  showProblem("");
  document.title = `Teleoperation: ${hello.env}`;
  $("env").textContent = hello.env;
  $("path").textContent = hello.path;
  const canDrive = Object.keys(hello.keys).length > 0;
  $("keys").replaceChildren(...Object.entries(hello.keys).map(([key, does]) => {
    const item = document.createElement("li");
    item.dataset.key = key;
    const cap = document.createElement("kbd");
    cap.textContent = CAPS[key] ?? key.toUpperCase();
    item.append(cap, does);
    return item;
  }));
  const watching = hello.watched
    ? "A policy drives, and nothing is recorded."
    : "No keys drive this robot: it can only be watched, and nothing is recorded.";
  $("keys-note").textContent = canDrive
    ? "Enter starts, pauses and resumes. Drag the picture to turn the view, scroll to zoom."
    : watching;
  $("camera-label").hidden = hello.cameras.length < 2;
  $("camera").replaceChildren(...hello.cameras.map((name, i) => new Option(name, i)));
  if (hello.no_pictures) {
    $("picture").hidden = true;
    $("no-picture").hidden = false;
    $("no-picture").textContent =
      `No pictures: ${hello.no_pictures}. Driving and recording go on without.`;
  }
}

function hearRole(message) {
  role = message;
  if (!role.drives) release();
  const watching = role.free ? "watching; nobody drives" : "watching; another page drives";
  $("role").textContent = role.drives ? "you drive" : watching;
  $("role").className = role.drives ? "badge drives" : "badge";
  $("drive").hidden = role.drives || !role.free;
  recordedShown = -1;
  showControls();
}

function hearStatus(message) {
  status = message;
  showFigures();
  showControls();
  if (recordedShown !== status.num_recorded) showRecorded(status.num_recorded);
  for (const row of $("recorded").rows) {
    row.classList.toggle("playing", Number(row.dataset.episode) === status.playing);
  }
}

function hearProblem(message) {
  showProblem(message.text);
}

function showProblem(text) {
  $("problem").textContent = text;
  $("problem").hidden = !text;
}

function showPicture(blob) {
  const before = pictureUrl;
  pictureUrl = URL.createObjectURL(blob);
  $("picture").src = pictureUrl;
  $("picture").hidden = false;
  $("no-picture").hidden = true;
  if (before) URL.revokeObjectURL(before);
}

function number(value, digits = 1) {
  if (value === null || value === undefined) return "–";
  return value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
}

function showFigures() {
  const figures = {
    "Return": number(status.return),
    "Reward of the step": number(status.reward, 3),
    ...Object.fromEntries(
      Object.entries(status.readings).map(([name, value]) => [capital(name), number(value, 3)]),
    ),
    "Time": `${number(status.seconds)} s`,
    "Step": `${status.step} of ${status.horizon}`,
  };
  if (status.speed < 0.95) figures["Speed"] = `${number(100 * status.speed, 0)} % of real time`;
  const names = Object.keys(figures);
  const shown = [...$("figures").querySelectorAll("dt")].map((term) => term.textContent);
  if (names.join() !== shown.join()) {
    $("figures").replaceChildren(...names.map((name) => {
      const pair = document.createElement("div");
      const term = document.createElement("dt");
      term.textContent = name;
      pair.append(term, document.createElement("dd"));
      return pair;
    }));
  }
  [...$("figures").querySelectorAll("dd")].forEach((value, i) => {
    value.textContent = figures[names[i]];
  });
}

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function showControls() {
  const phase = status?.phase ?? "";
  const canDrive = Object.keys(hello.keys).length > 0;
  const again = phase === "over" && !canDrive; // There is nothing to save first.
  const [label, command] = again ? AGAIN : (PRIMARY[phase] ?? ["Start", ""]);
  const unfinished = ["driving", "paused", "over"].includes(phase);
  $("phase").textContent =
    phase === "driving" && !canDrive ? "watching" : (PHASES[phase] ?? "not connected");
  $("phase").className = `phase ${phase}`;
  $("primary").textContent = label;
  $("primary").dataset.command = command;
  $("primary").disabled = !role.drives || !command;
  $("save").disabled = !(role.drives && canDrive && unfinished && status.step > 0);
  $("discard").disabled = !(role.drives && unfinished);
  $("strategy").disabled = !(role.drives && canDrive);
  $("camera").disabled = !role.drives;
  $("notice").textContent = status?.notice ?? "";
  if (status) {
    $("camera").value = status.camera;
    showStrategies(status.num_strategies);
  }
}

// Strategies are numbered without a gap: those there are, and one that is new.
function showStrategies(known) {
  const list = $("strategy");
  if (list.options.length === known + 1) return;
  const chosen = list.value || 1;
  list.replaceChildren(...Array.from({ length: known + 1 }, (_, i) =>
    new Option(i < known ? `${i + 1}` : `${i + 1} (new)`, i + 1)));
  list.value = chosen;
}

async function showRecorded(num) {
  recordedShown = num;
  const episodes = await (await fetch("recorded")).json();
  const perStrategy = new Map();
  $("recorded").replaceChildren(...episodes.map((episode, i) => {
    perStrategy.set(episode.strategy, (perStrategy.get(episode.strategy) ?? 0) + 1);
    const row = document.createElement("tr");
    row.dataset.episode = i + 1;
    const cells = [i + 1, episode.strategy, episode.steps, number(episode.return)];
    for (const text of cells) row.insertCell().textContent = text;
    const play = document.createElement("button");
    play.textContent = "Play";
    play.disabled = !episode.playable || !role.drives;
    play.title = episode.playable ? "" : "Not recorded here: where it started is not known";
    play.onclick = () => command({ do: "play", episode: i + 1 });
    row.insertCell().append(play);
    return row;
  }).reverse());
  const counts = [...perStrategy].sort(([a], [b]) => a - b).map(([s, n]) => `${n} of strategy ${s}`);
  $("count").textContent = counts.length ? counts.join(", ") : "nothing yet";
}

function command(message) {
  showProblem("");
  document.activeElement?.blur(); // Else the next space would press the button again.
  send(message);
}

function tellKeys() {
  if (role.drives) send({ do: "keys", held: [...new Set(down.values())] });
  for (const item of $("keys").children) {
    item.classList.toggle("down", [...down.values()].includes(item.dataset.key));
  }
}

function release() {
  down.clear();
  tellKeys();
}

// A key by its name or, where the keyboard writes another script, by its place.
function keyName(event) {
  const name = event.key.toLowerCase();
  return name in hello.keys ? name : event.code.replace(/^Key/, "").toLowerCase();
}

window.addEventListener("keydown", (event) => {
  if (!role.drives || event.ctrlKey || event.metaKey || event.altKey) return;
  const name = keyName(event);
  if (name in hello.keys) {
    event.preventDefault();
    if (event.repeat) return;
    down.set(event.code, name);
    tellKeys();
  } else if (event.key === "Enter" && !event.repeat && event.target === document.body) {
    $("primary").click();
  }
});
window.addEventListener("keyup", (event) => {
  if (down.delete(event.code)) {
    event.preventDefault();
    tellKeys();
  }
});
window.addEventListener("blur", release);
document.addEventListener("visibilitychange", () => {
  if (!document.hidden) return;
  release();
  if (role.drives && status?.phase === "driving") send({ do: "pause" });
});
setInterval(() => (down.size || status?.phase === "driving") && tellKeys(), TOLD_AGAIN_MS);

$("primary").onclick = (event) => command({ do: event.currentTarget.dataset.command });
$("save").onclick = () => command({ do: "save", strategy: Number($("strategy").value) });
$("discard").onclick = () => command({ do: "discard" });
$("drive").onclick = () => command({ do: "drive" });
$("strategy").onchange = () => document.activeElement.blur();
$("camera").onchange = () => command({ do: "choose", camera: Number($("camera").value) });

// Many movements may come between two pictures; they are sent together.
let turn = { right: 0, down: 0, closer: 0 };
function orbit(right, downwards, closer) {
  if (!role.drives) return;
  if (!(turn.right || turn.down || turn.closer)) {
    requestAnimationFrame(() => {
      send({ do: "orbit", ...turn });
      turn = { right: 0, down: 0, closer: 0 };
    });
  }
  turn.right += right;
  turn.down += downwards;
  turn.closer += closer;
}
$("picture").addEventListener("pointerdown", (event) => {
  $("picture").setPointerCapture(event.pointerId);
});
$("picture").addEventListener("pointermove", (event) => {
  if (event.buttons) {
    orbit(DEGREES_PER_PIXEL * event.movementX, DEGREES_PER_PIXEL * event.movementY, 0);
  }
});
$("picture").addEventListener("wheel", (event) => {
  event.preventDefault();
  orbit(0, 0, -CLOSER_PER_WHEEL * event.deltaY);
}, { passive: false });

connect();
