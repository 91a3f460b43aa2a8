// The page on which people rate: what comes next is fetched and decoded ahead, answers are sent behind.

import { Aside } from "./aside.js";
import { Outbox, newId, post } from "./outbox.js";
import { Stage, prepare, showAll } from "./player.js";
import { RadioRow, SliderRow, shortened } from "./rows.js";

const AHEAD = 3; // items that are held ready beside the one that is shown
const MOST = 20; // that the server hands out at once
const POLL = 3000; // milliseconds between two looks for something new
const REST = 300; // milliseconds in which a second click or key press cannot be meant for the new item
const NOTHING = "Nothing left for now";
const KEPT = 20; // answers that can be taken back

const config = JSON.parse(document.body.dataset.config);
const find = (id) => document.getElementById(id);
const place = { stage: find("stage"), form: find("form"), hint: find("hint"), work: find("work"), message: find("message"), status: find("status") };
const stage = new Stage(place.stage);
const rows = [...document.querySelectorAll(".row")].map((row) => new (config.kind === "slider" ? SliderRow : RadioRow)(row, config));
const comment = find("comment");
const who = `${config.project}:${config.rater}`;

let tasks = []; // that come next
let current = null;
let shownAt = 0;
let active = 0; // the row that digits and arrows are for
let waiting = null; // the practice answer whose feedback is awaited
let undoing = null; // the undo whose item is awaited
let asked; // when the last answer was given, until the next item is there
let turn = 0; // grows with every item, so that what comes late is known to be late
let paused = false;
let answered = 0;
let sinceBreak = 0;
let quietNotes = 0;
let filling = false;
let pollTimer;
const gone = new Set(); // leases that were answered here, and items whose file is missing
const history = recall();

const broken = new Map(); // leases of what this browser cannot show, and which item it is
const page = { rater: config.rater, question: config.question };
const outbox = new Outbox(`uard-outbox:${who}`, page, { told, refused, stopped, changed: showStatus });
const aside = new Aside(outbox, () => open("aside"));

function recall() {
  try {
    return JSON.parse(sessionStorage.getItem(`uard-given:${who}`) ?? "[]").map((id) => ({ id, task: null }));
  } catch {
    return [];
  }
}

function remember() {
  try {
    sessionStorage.setItem(`uard-given:${who}`, JSON.stringify(history.map((entry) => entry.id)));
  } catch { /* then there is no undo after a reload */ }
}

// --- what comes next -------------------------------------------------------------------------------------------------

const unsent = () => outbox.records().filter((record) => record.path === "/api/answers");

async function fill() {
  clearTimeout(pollTimer);
  if (filling || outbox.locked) return;
  filling = true;
  let again = current || tasks.length ? null : POLL;
  try {
    const response = await post("/api/next", { ...page, count: Math.min(AHEAD + 1 + unsent().length, MOST) });
    if ([401, 409].includes(response.status)) {
      const { error, why } = await response.json();
      outbox.stop(error, why);
      return;
    }
    if (!response.ok) throw new Error(String(response.status));
    take(await response.json());
    again = current || tasks.length ? null : POLL;
  } catch {
    again = 1500;
    if (!current && !tasks.length) say("Waiting for the server", "This page goes on by itself as soon as it answers.");
  } finally {
    filling = false;
  }
  if (again) pollTimer = setTimeout(fill, again);
}

function take(reply) {
  for (const { body } of outbox.records()) if (body.lease) gone.add(body.lease);
  const waitingToBeSent = unsent().filter((record) => !record.practice).length;
  answered = reply.progress.answered + waitingToBeSent;
  showProgress(Math.max(reply.progress.open - waitingToBeSent, 0));
  paused = reply.paused;
  if (paused) {
    tasks = [];
    current = null;
    stage.stop();
    say("Paused", "The owner of this project has paused your part. This page goes on by itself when it is your turn again.");
    return;
  }
  const known = new Set([current, ...tasks].filter(Boolean).map((task) => task.lease));
  for (const { lease } of reply.tasks) if (broken.has(lease)) report(lease); // to a server that was started again
  for (const task of reply.tasks) if (!known.has(task.lease) && !gone.has(task.lease)) tasks.push(ready(task));
  tasks.sort((a, b) => (b.kind === "practice") - (a.kind === "practice"));
  if (!current && !waiting && !undoing) {
    if (tasks.length) next();
    else say(NOTHING, "You have rated all there is for you. Thank you! This page looks for more by itself.");
  }
}

// Begins to fetch what a task needs, and tries again while the server is away.
function ready(task) {
  task.contents = task.sides ? [task.left, task.right] : [task.item];
  const attempt = async () => {
    for (;;) {
      try {
        return await Promise.all(task.contents.map((content) => prepare(content).catch((error) => {
          error.item = content?.id;
          throw error;
        })));
      } catch (error) {
        if (!(error instanceof TypeError) && !/^(401|429|5\d\d)$/.test(error.message)) throw error;
        await new Promise((resolve) => setTimeout(resolve, 1000));
      }
    }
  };
  task.ready = attempt();
  task.ready.then((parts) => { task.parts = parts; }, (error) => {
    task.broken = true;
    broken.set(task.lease, error.item);
    report(task.lease);
  });
  return task;
}

// Tells the server what this browser cannot show, so that something else comes in its place.
function report(lease) {
  const body = { rater: config.rater, lease };
  if (broken.get(lease)) body.item = broken.get(lease);
  post("/api/broken", body).then(fill, () => { /* it is told again when it comes again */ });
}

function release(task) {
  for (const part of task?.parts ?? []) part.sheet?.close();
  if (task) task.parts = task.ready = null;
}

// Shows the next item; `since` is when the last one was answered.
async function next(since) {
  if (outbox.locked) return;
  asked = since ?? asked;
  const mine = ++turn;
  current = tasks.shift() ?? null;
  if (!current) {
    say("One moment", "The next item is on its way.");
    fill();
    return;
  }
  const task = current.ready ? current : ready(current);
  if (!task.parts) {
    const late = setTimeout(() => { if (mine === turn) say("One moment", "The next item is on its way."); }, 200);
    try {
      await task.ready;
    } catch {
      gone.add(task.lease); // the server is told of it, and hands it out no more
    }
    clearTimeout(late);
    if (mine !== turn) return;
    if (task.broken) {
      hint("An item was left out: this browser cannot show it.");
      next();
      return;
    }
  }
  show(task);
}

function show(task) {
  place.message.hidden = true;
  place.work.hidden = false;
  find("practice").hidden = task.kind !== "practice";
  stage.show(task.parts, task.sides ? ["Left", "Right"] : [task.item.kind === "text" ? "Text" : "Clip"]);
  for (const row of rows) row.reset();
  if (comment) comment.value = "";
  activate(0, rows.some((row) => row.place.contains(document.activeElement)));
  find("undo").disabled = !history.length;
  shownAt = performance.now();
  if (document.querySelector("dialog[open]")) stage.stop();
  document.body.dataset.item = task.item.id;
  const since = asked;
  asked = undefined;
  if (since) requestAnimationFrame(() => { document.body.dataset.switched = String(performance.now() - since); });
}

// --- answers ---------------------------------------------------------------------------------------------------------

function submit(event, skip = false) {
  if (!current || waiting || undoing || place.work.hidden || document.querySelector("dialog[open]")) return;
  const soon = performance.now() - shownAt < REST;
  const missing = skip ? [] : rows.filter((row) => !row.isSet);
  if (soon && (skip || missing.length)) return;
  if (missing.length) {
    hint(rows.length > 1 ? `Still to rate: ${missing.map((row) => row.name || "your rating").join(", ")}.` : "Choose something first, or skip.");
    activate(rows.indexOf(missing[0]), true);
    return;
  }
  const task = current;
  const chosen = skip ? "skip" : rows[0].config.kind === "pairs" || rows[0].config.kind === "thumbs" ? rows[0].choice : null;
  const body = {
    id: newId(),
    lease: task.lease,
    item: task.item.id,
    left: task.sides?.[0] ?? null,
    right: task.sides?.[1] ?? null,
    values: chosen === null ? Object.fromEntries(rows.map((row) => [row.name, row.value])) : null,
    choice: chosen,
    comment: comment?.value ?? "",
    seconds: (performance.now() - shownAt) / 1000,
  };
  gone.add(task.lease);
  release(history.at(-1)?.task);
  history.push({ id: body.id, task });
  if (history.length > KEPT) history.shift();
  remember();
  hint("");
  const practice = task.kind === "practice" && !skip;
  if (practice) {
    waiting = body.id;
    stage.stop();
  }
  outbox.add("/api/answers", body);
  if (practice) return;
  answered += 1;
  showProgress(Math.max(showProgress.open - 1, 0));
  next(event?.timeStamp);
  proposeBreak();
}

function told(record, reply) {
  if (record.path === "/api/undo") {
    if (undoing === record.body.id) {
      undoing = null;
      if (reply.task) {
        gone.delete(reply.task.lease);
        tasks = [ready(reply.task), ...tasks.filter((task) => task.lease !== reply.task.lease)];
      }
      next();
    }
  } else if (waiting === record.body.id) {
    waiting = null;
    if (reply.feedback) showFeedback(reply.feedback);
    else next();
  } else if (reply.note && --quietNotes < 0) {
    quietNotes = 10;
    note(reply.note);
  }
  fill();
}

function refused(record, sentence) {
  if (record.path === "/api/undo") {
    if (undoing === record.body.id) {
      undoing = null;
      next();
    }
    return;
  }
  note(`An answer was not accepted, and is kept aside. ${sentence}`);
  if (waiting === record.body.id) {
    waiting = null;
    next();
  }
}

// The page can do nothing more as it is; what was said stays in this browser.
function stopped(sentence, why) {
  const number = unsent().length;
  const kept = number ? ` ${number === 1 ? "One answer is" : `${number} answers are`} kept in this browser.` : "";
  const titles = { rater: "This browser is another rater's now", question: "The question was changed" };
  const more = { question: " Load this page again to go on." }[why] ?? "";
  say(titles[why] ?? "Your link is needed", `${sentence}${kept}${more}`);
}

function undo() {
  if (!history.length || waiting || undoing || document.querySelector("dialog[open]")) return;
  const { id, task } = history.pop();
  remember();
  hint("");
  if (current) tasks.unshift(current);
  if (task) {
    gone.delete(task.lease);
    tasks.unshift(task);
    if (task.kind !== "practice") {
      answered = Math.max(answered - 1, 0);
      showProgress(showProgress.open + 1);
    }
  }
  if (!outbox.withdraw(id)) {
    const body = { id: newId(), answer: id };
    if (!task) undoing = body.id;
    outbox.add("/api/undo", body);
  } else if (!task) {
    next();
    return;
  }
  if (task) next();
  else {
    current = null;
    say("One moment", "Your last answer is being taken back.");
  }
}

// --- what the page says ----------------------------------------------------------------------------------------------

function say(title, text) {
  if (find("message-title").textContent !== title || place.message.hidden) {
    find("message-title").textContent = title;
    find("message-text").textContent = text;
  }
  find("undo-last").hidden = title !== NOTHING || !history.length;
  place.message.hidden = false;
  place.work.hidden = true;
  stage.stop();
}

function hint(text) {
  place.hint.textContent = text;
}

let noteText = "";
let noteTimer;
function note(text) {
  noteText = text;
  clearTimeout(noteTimer);
  noteTimer = setTimeout(() => { noteText = ""; showStatus(); }, 8000);
  showStatus();
}

let since = null; // when the oldest answer that is still on its way was given
let slow;
function showStatus() {
  const number = outbox.records().length;
  since = number ? since ?? performance.now() : null;
  clearTimeout(slow);
  const late = number > 0 && (outbox.failures > 0 || performance.now() - since > 1500);
  if (number && !late) slow = setTimeout(showStatus, 1600);
  const parts = [];
  if (late) parts.push(`Not saved yet: ${number === 1 ? "1 answer waits" : `${number} answers wait`} for the connection.`);
  if (late && outbox.why) parts.push(outbox.why);
  if (!outbox.kept && number) parts.push("Keep this page open: this browser stores nothing for us.");
  if (noteText && !late) parts.push(noteText);
  const text = parts.join(" ");
  if (place.status.textContent !== text) place.status.textContent = text;
  place.status.classList.toggle("warning", Boolean(late));
  aside.tell();
}

function showProgress(open) {
  showProgress.open = open;
  find("progress").value = answered + open ? answered / (answered + open) : 0;
  find("count").textContent = `${answered} answered${open ? `, about ${open} to go` : ""}`;
}
showProgress.open = 0;

function showFeedback({ right, value, choice, why }) {
  find("feedback-title").textContent = right ? "Just so" : "Not quite";
  const expected = { up: "thumbs up", down: "thumbs down", left: "the left one", right: "the right one", tie: "a tie" }[choice] ?? `${shortened(value)} ${config.unit}`;
  find("feedback-text").textContent = `${right ? "Expected was" : "Expected was rather"} ${expected}.`;
  find("feedback-why").textContent = why;
  open("feedback", () => next());
}

function proposeBreak() {
  sinceBreak += 1;
  if (!config.break_after || sinceBreak < config.break_after || !current) return;
  sinceBreak = 0;
  find("break-text").textContent = `You have given ${config.break_after} answers in a row. Eyes and judgement are better after a few minutes off; all that you said is kept.`;
  open("break");
}

function open(id, then) {
  const dialog = find(id);
  if (dialog.open) return;
  stage.stop();
  dialog.addEventListener("close", () => {
    shownAt = performance.now();
    const missing = rows.findIndex((row) => !row.isSet);
    if (rows.length > 1 && missing >= 0 && !place.work.hidden) activate(missing, true); // the browser gives the focus back to where it was
    if (then) then();
    else if (current && !place.work.hidden && stage.autoplay && !window.matchMedia("(prefers-reduced-motion: reduce)").matches) stage.play();
  }, { once: true });
  dialog.showModal();
}

let examplesShown = false;
function showInstructions() {
  if (!examplesShown) showAll("#instructions .example");
  examplesShown = true;
  open("instructions");
}

function firstTime() {
  const key = `uard-told:${who}:${config.instructions}`;
  try {
    if (localStorage.getItem(key)) return;
    find("instructions").addEventListener("close", () => { try { localStorage.setItem(key, "1"); } catch { /* then they are shown again */ } }, { once: true });
  } catch { /* likewise */ }
  showInstructions();
}

// --- keys and clicks -------------------------------------------------------------------------------------------------

function activate(at, focus = false) {
  active = at;
  rows.forEach((row, k) => row.place.classList.toggle("active", rows.length > 1 && k === at));
  if (focus) rows[at].focus();
}

function pressed(event) {
  const { key, target } = event;
  const writing = target.matches?.("textarea, input[type=text]");
  if (event.repeat && !writing && ["Enter", " ", "s", "u"].includes(key)) {
    event.preventDefault();
    event.stopPropagation();
    return;
  }
  if (document.querySelector("dialog[open]")) return;
  if (writing) {
    if (key === "Escape") target.blur();
    if (key === "Enter" && (event.ctrlKey || event.metaKey)) submit(event);
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || (place.work.hidden && !["h", "?", "i"].includes(key) && !(key === "u" && !find("undo-last").hidden))) return;
  if (handle(event)) event.preventDefault();
}

// Does what a key stands for; false if it is to do what it always does.
function handle(event) {
  const { key, target } = event;
  const button = target.matches?.("button, summary, a");
  if (key === "Enter" || key === " ") {
    if (button || (key === " " && !stage.clips.length)) return false;
    if (key === "Enter") submit(event);
    else stage.toggle();
    return true;
  }
  if (/^[0-9]$/.test(key)) {
    if (!rows[active].digit(Number(key))) return false;
    hint("");
    const missing = rows.findIndex((row) => !row.isSet);
    if (rows.length > 1 && missing >= 0) activate(missing, true);
    return true;
  }
  if (key.startsWith("Arrow")) {
    const upDown = key === "ArrowUp" || key === "ArrowDown";
    if (target.matches?.(".scrub") || (upDown && target.matches?.(".text"))) return false;
    hint("");
    return rows[active].arrow(key, event.shiftKey);
  }
  const does = {
    s: () => submit(event, true),
    u: undo,
    ",": () => stage.step(-1),
    ".": () => stage.step(1),
    "-": () => stage.changeSpeed(-1),
    "+": () => stage.changeSpeed(1),
    "=": () => stage.changeSpeed(1),
    c: () => comment?.focus(),
    i: showInstructions,
    h: () => open("help"),
    "?": () => open("help"),
  }[key];
  does?.();
  return Boolean(does);
}

const once = (does) => (event) => { if (event.detail < 2) does(event); }; // the second click of a double click is none

document.addEventListener("keydown", pressed, true);
place.form.addEventListener("submit", (event) => { event.preventDefault(); });
find("submit").addEventListener("click", (event) => { event.preventDefault(); once(submit)(event); });
find("skip").addEventListener("click", once((event) => submit(event, true)));
find("undo").addEventListener("click", once(undo));
find("undo-last").addEventListener("click", once(undo));
find("show-help").addEventListener("click", () => open("help"));
find("show-instructions").addEventListener("click", showInstructions);
rows.forEach((row, k) => {
  row.place.addEventListener("focusin", () => activate(k));
  row.place.addEventListener("change", () => hint(""));
});
if (config.kind === "pairs") {
  rows[0].changed = (choice) => {
    for (const [k, panel] of [...place.stage.querySelectorAll(".panel")].entries()) panel.classList.toggle("chosen", choice === ["left", "right"][k]);
  };
}

say("One moment", "The first item is on its way.");
showStatus();
firstTime();
outbox.run();
fill();
