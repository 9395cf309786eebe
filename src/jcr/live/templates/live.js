"use strict";
(() => {
  const element = (id) => document.getElementById(id);
  let version = -1, isDone = false, report = null;
  // A part is replaced where it has changed, so that the reader's selection and the images stay.
  const parts = {};
  async function ask() {
    try {
      const found = await (await fetch(`state?version=${version}`)).json();
      element("away").hidden = true;
      // The answer to the last version tells the server that the page has it; the server then ends.
      if (found.version === version) { isDone = isDone || document.body.dataset.done === "true"; return; }
      // The report is kept in the page, so that its link works when the server has ended.
      if (found.has_report && !report) report = URL.createObjectURL(await (await fetch("report.html")).blob());
      version = found.version;
      for (const [name, html] of Object.entries(found.parts)) {
        if (parts[name] !== html) element(name).innerHTML = parts[name] = html;
      }
      if (report && element("report")) Object.assign(element("report"), { href: report, hidden: false });
      const main = document.querySelector("main");
      main.toggleAttribute("data-over", found.is_over);
      main.toggleAttribute("data-images", found.images > 0);
      document.body.dataset.done = found.is_done;
      const holder = element("scene-data");
      if (holder.textContent !== found.scene) {
        holder.textContent = found.scene;
        holder.dispatchEvent(new Event("change"));
      }
    } catch {
      // After the end that the page has shown, nobody answers any more.
      element("away").hidden = document.body.dataset.done === "true";
    }
  }
  async function look() {
    if (document.hidden) return;
    try {
      const answer = await fetch("now.jpg");
      if (answer.status !== 200) return;
      const url = URL.createObjectURL(await answer.blob());
      const image = element("now");
      URL.revokeObjectURL(image.src);
      image.src = url;
      image.hidden = false;
      element("features").textContent = answer.headers.get("X-Features");
    } catch { /* The state says that nobody answers. */ }
  }
  document.addEventListener("click", async (event) => {
    const button = event.target.closest("[data-press]");
    if (!button || (button.dataset.ask && !confirm(button.dataset.ask))) return;
    const number = button.dataset.number ? Number(button.dataset.number) : null;
    button.disabled = true;
    try {
      await fetch("press", {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ action: button.dataset.press, number }),
      });
    } finally {
      button.disabled = false;
      setTimeout(ask, 100);
    }
  });
  async function repeat(action, every) {
    while (!isDone) {
      await action();
      await new Promise((resolve) => setTimeout(resolve, every));
    }
  }
  repeat(ask, 700);
  repeat(look, 1000);
})();
