// Loaded from disk, where a page may not fetch: a script that calls a function is what a file can send.
let shown = null, heard = Date.now();
function show(body) {
  if (body === shown) return;
  if (shown !== null) document.getElementById("body").innerHTML = body;
  shown = body;
}
function now(seen) {
  const words = document.getElementById("words");
  const text = seen.time + ": " + seen.words;
  if (words.textContent !== text) {
    heard = Date.now();
    document.getElementById("now").src = "live/now.jpg?" + encodeURIComponent(seen.time);
  }
  words.textContent = text;
  words.style.color = seen.few ? "var(--warn)" : "";
  const silent = (Date.now() - heard) / 1000;
  document.getElementById("stale").textContent =
    silent > 10 ? "No new image for " + silent.toFixed(0) + " s: jcr capture has ended or waits for its camera." : "";
}
function load(file) {
  const script = document.createElement("script");
  script.src = file + "?" + Date.now();
  script.onload = script.onerror = () => script.remove();
  document.head.append(script);
}
setInterval(() => { load("live/now.js"); load("live/state.js"); }, 1000);
load("live/now.js");
