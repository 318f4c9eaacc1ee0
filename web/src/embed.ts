// Embedding in another page, and the messages between them: docs/viewer.md.
import { BESIDE } from './bundle/source';
import { type Camera, type Shared, cameraOf, viewpointOf } from './view/share';

const PREFIX = 'bitymi/1/';

// Interface of the viewer to messages.
export interface Embedded {
  shared(): Shared;
  apply(shared: Shared): void;
  readonly notes: { names: string[]; goTo(name: string): boolean }; // false: no saved view of that name
}

// Returns the embedding page's origin, from the browser, this page before it loaded another bundle, or the referrer.
function around(): string {
  const { ancestorOrigins } = location as { ancestorOrigins?: DOMStringList }; // not in all browsers
  const kept = new URLSearchParams(location.hash.slice(1)).get('embedder');
  const referrer = URL.canParse(document.referrer) ? new URL(document.referrer).origin : '';
  return ancestorOrigins?.[0] ?? kept ?? referrer;
}

export class Embed {
  private readonly origins: Set<string>; // allowed to exchange messages
  private readonly parent: string | null; // origin of the embedding page, if allowed
  private viewer: Embedded | null = null;
  private last = '';

  constructor() {
    const named = document.querySelector<HTMLMetaElement>('meta[name=embedders]')?.content ?? '';
    this.origins = new Set([location.origin, ...named.split(/\s+/).filter(Boolean)]);
    this.parent = parent !== window && this.origins.has(around()) ? around() : null;
    if (!this.parent) return;
    addEventListener('message', ({ source, origin, data }) => {
      if (source === parent && origin === this.parent) this.heed(data);
    });
  }

  ready(viewer: Embedded, title: string): void {
    this.viewer = viewer;
    this.send('ready', { title, camera: cameraOf(viewer.shared()) });
  }

  // Reports the camera after a frame, if it has moved.
  shown(): void {
    if (!this.parent || !this.viewer) return;
    const camera = cameraOf(this.viewer.shared());
    const text = JSON.stringify(camera);
    if (text === this.last) return;
    this.last = text;
    this.send('camera', { camera });
  }

  failed(title: string, message: string): void {
    this.send('error', { title, message });
  }

  private send(event: string, content: object): void {
    if (this.parent) parent.postMessage({ type: PREFIX + event, ...content }, this.parent);
  }

  private heed(data: unknown): void {
    if (typeof data !== 'object' || data === null) return;
    const { type, id, camera, file, name } = data as Record<string, unknown>;
    if (typeof type !== 'string' || !type.startsWith(PREFIX)) return;
    const refuse = (message: string): void => this.send('error', { id, title: 'The message is refused', message });
    if (type === `${PREFIX}load`) {
      if (file !== '' && !(typeof file === 'string' && BESIDE.test(file))) {
        refuse('file must be the name of a .bitymi file beside the page, or empty.');
        return;
      }
      const address = new URL(file ? `?file=${encodeURIComponent(file)}` : location.pathname, location.href);
      address.hash = `embedder=${encodeURIComponent(this.parent!)}`;
      // for the same bundle only the fragment would change, without a reload
      const same = address.search === location.search;
      location.replace(address);
      if (same) location.reload();
    } else if (!this.viewer) {
      refuse('The scene is not shown yet: wait for ready.');
    } else if (type === `${PREFIX}get-camera`) {
      this.send('camera', { id, camera: cameraOf(this.viewer.shared()) });
    } else if (type === `${PREFIX}set-camera`) {
      const viewpoint = viewpointOf(camera as Camera);
      if (viewpoint) this.viewer.apply({ ...this.viewer.shared(), ...viewpoint });
      else refuse('camera must have position, right, forward, target and lens.');
    } else if (type === `${PREFIX}list-views`) {
      this.send('views', { id, views: this.viewer.notes.names });
    } else if (type === `${PREFIX}go-to-view`) {
      if (typeof name !== 'string' || !this.viewer.notes.goTo(name)) refuse('name must be that of a saved view.');
    } else {
      refuse('There is no such message.');
    }
  }
}
