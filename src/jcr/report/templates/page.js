// Copy buttons, each with the text that it copies; links and printing open collapsed sections.
"use strict";
async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // Pages opened from a mail or an old browser may not use the clipboard: select a copy and ask the browser.
    const area = (document.querySelector("dialog[open]") || document.body).appendChild(document.createElement("textarea"));
    area.value = text;
    area.select();
    document.execCommand("copy");
    area.remove();
  }
}
document.querySelectorAll("button[data-copy]").forEach((button) => {
  const label = button.textContent;
  button.addEventListener("click", async () => {
    await copyText(button.dataset.copy);
    button.textContent = "copied";
    setTimeout(() => { button.textContent = label; }, 1500);
  });
});
const openLinked = () => {
  const linked = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (linked && linked.tagName === "DETAILS") linked.open = true;
};
addEventListener("hashchange", openLinked);
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => { one.open = true; }));
openLinked();
