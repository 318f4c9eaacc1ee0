/* global document, location, addEventListener, HTMLScriptElement */
// Inline script that locates the page's scripts, or explains why it does not start. An address ending in /fox without a
// slash means the folder fox, to which names are then relative, or, on servers that hide extensions, fox.html: scripts
// that the folder lacks are requested beside it.
(function () {
  const root = document.documentElement;
  const name = location.pathname.split('/').pop();
  const folder = name && !/\.html?$|^index$/.test(name) ? document.createElement('base') : null;
  if (folder) {
    folder.setAttribute('href', `./${name}/`);
    document.head.append(folder);
  }
  const asked = new Set();

  function say(text, advice) {
    root.dataset.state = 'error';
    document.getElementById('page-title').textContent = 'The viewer cannot start';
    document.getElementById('page-text').textContent = text;
    document.getElementById('page-advice').textContent = advice;
    for (const id of ['page-progress', 'page-late']) document.getElementById(id).hidden = true;
  }
  function stopped() {
    if (document.readyState === 'loading') return addEventListener('DOMContentLoaded', stopped);
    if (root.dataset.state) return; // the page has started
    if (location.protocol === 'file:') {
      say(
        'This page was opened as a file, and browsers load no viewer from files.',
        'Open it from a web server: "bitymi view BUNDLE" is one, and so is "python -m http.server" in this folder.',
      );
    } else {
      say(
        'A script of this page cannot be loaded, or this browser does not read it.',
        'Reload the page, open it with index.html at the end of its address, or update the browser.',
      );
    }
  }
  // a file failed to load (such events do not bubble to the window) or cannot be read
  function failed({ target }) {
    if (!folder || !(target.src || target.href) || asked.has(target)) return stopped();
    folder.remove();
    const again = document.createElement(target.localName);
    for (const { name, value } of target.attributes) again.setAttribute(name, value);
    if (again.src) again.onload = stopped; // another page's script, which did not start this one
    asked.add(again);
    target.replaceWith(again);
  }
  addEventListener('error', failed, true);
  if (!('noModule' in HTMLScriptElement.prototype)) addEventListener('DOMContentLoaded', stopped);
})();
