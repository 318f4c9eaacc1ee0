/* global document, location, addEventListener, HTMLScriptElement */
// Says why the page does not start, where its own script cannot: a page that is opened as a file loads no modules.
(function () {
  function say(text, advice) {
    if (document.documentElement.dataset.state) return; // the page has started
    document.documentElement.dataset.state = 'error';
    document.getElementById('page-title').textContent = 'The viewer cannot start';
    document.getElementById('page-text').textContent = text;
    document.getElementById('page-advice').textContent = advice;
    document.getElementById('page-progress').hidden = true;
  }
  function stopped() {
    if (location.protocol === 'file:') {
      say(
        'This page was opened as a file, and browsers load no viewer from files.',
        'Open it from a web server: "bitymi view BUNDLE" is one, and so is "python -m http.server" in this folder.',
      );
    } else {
      say(
        'A script of this page cannot be loaded, or this browser does not read it.',
        'Reload the page, or update the browser.',
      );
    }
  }
  // of the loading of a script, which does not come up to the window, and of what cannot be read
  addEventListener('error', stopped, true);
  if (!('noModule' in HTMLScriptElement.prototype)) addEventListener('DOMContentLoaded', stopped);
})();
