// Drives one headless Chromium: each line of standard input is a job in JSON, its steps run in a page of a new context,
// and one line of standard output answers it.
import { createRequire } from 'node:module';
import { createInterface } from 'node:readline';

const [modules, chromium] = process.argv.slice(2);
const playwright = createRequire(`${modules}/`)('playwright-core');
const launch = () =>
  playwright.chromium.launch({
    executablePath: chromium,
    args: [
      ...['--enable-unsafe-webgpu', '--no-sandbox', '--disable-quic', '--no-first-run', '--disable-gpu-watchdog'],
      ...['--disable-background-networking', '--disable-component-update', '--disable-sync'],
    ],
  });

// a function and no text, which the page's policy would not evaluate
const settled = () => {
  const { state, frame } = document.documentElement.dataset;
  return state === 'error' || frame === 'still';
};

// Makes shaders do nothing: software graphics compile each page's for seconds, and most tests need no picture. The rest of
// the function stays, as it states what is bound.
const undrawn = () => {
  if (!self.GPUDevice) return; // not on about:blank
  const make = GPUDevice.prototype.createShaderModule;
  GPUDevice.prototype.createShaderModule = function (what) {
    const code = what.code
      .replace(/@compute[^{]*\{/g, '$& return;')
      .replace(/@fragment[^{]*\{/g, '$& return vec4f();');
    return make.call(this, { ...what, code });
  };
};

const press = (selector) => document.querySelector(selector).click();

// Saves the download that an action starts; returns its name.
const saved = async (page, done, path) => {
  const [download] = await Promise.all([page.waitForEvent('download'), done]);
  await download.saveAs(path);
  return download.suggestedFilename();
};

const actionsOf = (context, page) => ({
  init: ([script]) => page.addInitScript(script),
  goto: async ([url]) => {
    await page.goto('about:blank');
    await page.goto(url);
  },
  // until the picture stays, or the page says why there is none
  settle: () => page.waitForFunction(settled, null, { polling: 200 }),
  // until a picture is there without its texture
  first: () => page.waitForFunction(() => document.documentElement.dataset.frame === 'first', null, { polling: 100 }),
  // until the poster is shown
  poster: () => page.waitForFunction(() => !document.querySelector('#poster').hidden, null, { polling: 50 }),
  until: async ([expression]) => {
    const end = Date.now() + 45_000;
    while (!(await page.evaluate(expression))) {
      if (Date.now() > end) throw new Error(`${expression}: ${await page.evaluate('JSON.stringify(window.got ?? "")')}`);
      await page.waitForTimeout(50);
    }
  },
  loaded: ([selector]) => page.waitForFunction((s) => document.querySelector(s).naturalWidth > 0, selector),
  click: ([selector]) => page.click(selector),
  press: ([selector]) => page.evaluate(press, selector), // also where the screen is too small to show it
  key: ([key, held]) => page.keyboard.press(key, { delay: held ?? 0 }),
  hold: ([key]) => page.keyboard.down(key),
  release: ([key]) => page.keyboard.up(key),
  select: ([selector, value]) => page.selectOption(selector, value),
  // types into a field, as a person does
  fill: async ([selector, text]) => {
    await page.click(selector, { clickCount: 3 });
    await page.keyboard.type(text);
    await page.keyboard.press('Tab');
  },
  upload: ([selector, path]) => page.setInputFiles(selector, path),
  wheel: async ([at, by]) => {
    await page.mouse.move(...at);
    await page.mouse.wheel(0, by);
  },
  double: ([at]) => page.mouse.dblclick(...at),
  drag: async ([from, to, button]) => {
    await page.mouse.move(...from);
    await page.mouse.down({ button });
    await page.mouse.move(...to, { steps: 4 });
    await page.mouse.up({ button });
  },
  // fingers, one or more, which rest for some milliseconds before they are lifted
  fingers: async ([from, to, rest]) => {
    const session = await context.newCDPSession(page);
    const send = (type, points) =>
      session.send('Input.dispatchTouchEvent', { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
    await send('touchStart', from);
    for (let k = 1; k <= 4; k++) {
      await send('touchMove', from.map((p, i) => p.map((v, c) => v + ((to[i][c] - v) * k) / 4)));
    }
    await page.waitForTimeout(rest ?? 0);
    await send('touchEnd', []);
  },
  save: async ([selector, path]) => saved(page, page.evaluate(press, selector), path),
  'save by key': async ([key, path]) => saved(page, page.keyboard.press(key), path),
  shot: async ([path]) => void (await page.screenshot({ path })),
  ask: ([expression]) => page.evaluate(expression),
});

const run = async (browser, { steps, drawn, viewport, touch, ratio, patience }) => {
  const context = await browser.newContext({
    ...{ viewport, hasTouch: touch, isMobile: touch, deviceScaleFactor: ratio },
  });
  context.setDefaultTimeout(1000 * patience);
  const page = await context.newPage();
  const [results, problems] = [[], []];
  page.on('console', (message) => message.type() === 'error' && problems.push(message.text()));
  page.on('pageerror', (error) => problems.push(error.message));
  if (!drawn) await page.addInitScript(undrawn);
  const actions = actionsOf(context, page);
  for (const [action, ...args] of steps) results.push((await actions[action](args)) ?? null);
  await context.close();
  return { results, problems };
};

let browser = null;
for await (const line of createInterface({ input: process.stdin })) {
  let answer;
  try {
    browser ??= await launch();
    answer = await run(browser, JSON.parse(line));
  } catch (error) {
    // what a failed job leaves behind is not the next one's
    await browser?.close();
    browser = null;
    answer = { error: String(error.stack ?? error) };
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
await browser?.close();
