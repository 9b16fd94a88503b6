
// The tab Live: the server samples the blocks.
{
  let name = "";
  const answered = async (answer) => {
    if (answer.ok) return answer;
    const text = await answer.text();
    let refusal;
    try { refusal = JSON.parse(text); } catch { refusal = { error: text }; }
    throw Object.assign(new Error(refusal.error), { nearest: refusal.nearest });
  };
  const source = {
    async block({ text, from, path }) {
      const headers = { "Content-Type": "application/json" }, body = JSON.stringify({ stream: name, text, begin: from, path });
      const block = await (await answered(await fetch("live", { method: "POST", headers, body }))).json();
      name = block.stream;
      return block;
    },
    file: async (ending) => (await answered(await fetch(`live.${ending}?stream=${name}`))).blob(),
  };
  const DATA = /(<script type="application\/json" id="data">)[^]*?(<\/script>)/;

  async function openLive(element) {
    element.textContent = "Loading";
    try {
      const html = await (await answered(await fetch("live.html"))).text();
      const player = (motion) => html.replace(DATA, (_, begin, end) => begin + JSON.stringify([motion]).replaceAll("<", "\\u003c") + end);
      name = "";
      const { fps, stand: text, walk = null } = element.dataset;
      window.live = new Live(element, source, { read: (text) => text, text, walk, fps: +fps, player });
      await window.live.start();
    } catch (error) {
      element.textContent = error.message.split("\n")[0];
    }
  }

  document.addEventListener("click", (event) => {
    const start = event.target.closest("#live .start");
    if (start) openLive(start.closest("#live"));
  });
}
