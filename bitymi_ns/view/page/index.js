var e=class extends Error{title;advice;constructor(e,t,n){super(t),this.title=e,this.advice=n}},t=class extends e{},n=t=>new e(`This scene is too large for this device`,t,`Open it on a device with more memory.`),r=e=>e instanceof Error?e.message:String(e);function i(t){return t instanceof e?t:t instanceof RangeError?n(`There is not enough memory for it.`):new e(`The viewer stopped`,r(t),`Reload the page to try again.`)}var a=`Copy the bundle again from where it is whole, or export the scene again with ns-export bitymi-atlas.`,o=class extends e{constructor(e){super(`This bundle is damaged`,e,a)}},s=1e3/60,c=.2;function l(e,t,n){let r=e.getContext(`webgpu`);if(!r)throw Error(`The canvas gives no WebGPU context.`);return r.configure({device:n,format:navigator.gpu.getPreferredCanvasFormat(),alphaMode:`opaque`}),(n,i,a)=>{let{width:o,height:s}=n;return(e.width!==o||e.height!==s)&&Object.assign(e,{width:o,height:s}),t.draw(n,r.getCurrentTexture(),i,a)}}function u(e,t){let n=e.getContext(`2d`,{alpha:!1});if(!n)throw Error(`The canvas gives no 2D context.`);return async(r,i,a)=>{let[o,s]=[r.width,r.height].map(e=>Math.max(1,Math.round(e*i))),c=await t.read(r.scaledTo(o,s),a);Object.assign(e,{width:o,height:s}),n.putImageData(c,0,0)}}var d=(e,t,n)=>n.software?u(e,t):l(e,t,n.device),f=class{scale=1;milliseconds=0;took(e){this.milliseconds=this.milliseconds?.7*this.milliseconds+.3*e:e;let t=this.scale*Math.sqrt(.85*s/Math.max(this.milliseconds,.5)),n=Math.min(1,Math.max(c,t));if(Math.abs(n-this.scale)>.08*this.scale){let e=.5*(n-this.scale);this.scale+=Math.sign(e)*Math.max(Math.abs(e),Math.min(.05,Math.abs(2*e))),this.milliseconds=0}}};function p(e){let t=document.getElementById(e);if(!t)throw Error(`index.html has no element ${e}`);return t}var m=(e,t)=>e.setAttribute(`aria-pressed`,String(t)),h=e=>e.getAttribute(`aria-pressed`)===`true`;function g(e){return m(p(e),!h(p(e))),h(p(e))}function _(e,t,...n){let r=Object.assign(document.createElement(e),t);return r.append(...n),r}var v=(e,t)=>p(e).addEventListener(`click`,t),y=(e,{run:t,...n})=>_(`button`,{type:`button`,onclick:t,...n},e),b=e=>[HTMLSelectElement,HTMLInputElement,HTMLTextAreaElement].some(t=>e instanceof t),ee=e=>b(e)&&!(e instanceof HTMLInputElement&&e.type===`range`);function te(e,t){let n=_(`a`,{href:URL.createObjectURL(t),download:e});n.click(),setTimeout(()=>URL.revokeObjectURL(n.href),6e4)}var ne=65536,re=e=>e===`float`||e===`int`;function ie(e){let t=new TextDecoder(`latin1`).decode(new Uint8Array(e,0,Math.min(e.byteLength,ne))),n=t.indexOf(`end_header
`),r=t.slice(0,Math.max(n,0)).split(`
`);if(n<0||r[0]!==`ply`||r[1]!==`format binary_little_endian 1.0`)throw new o(`surfels.ply is not a binary little-endian PLY file.`);let i=new Map,a=null;for(let e of r.slice(2)){let t=e.split(` `);if(t[0]===`element`&&t.length===3&&/^\d{1,10}$/.test(t[2])&&!i.has(t[1]))a={count:Number(t[2]),stride:0,start:0,columns:new Map},i.set(t[1],a);else if(t[0]===`property`&&a&&re(t[1])&&!a.columns.has(t[2]))a.columns.set(t[2],{at:a.stride,type:t[1]}),a.stride+=4;else if(t[0]!==`comment`&&e!==``)throw new o(`surfels.ply has a header that cannot be read.`)}let s=n+11;for(let e of i.values())e.start=s,s+=e.count*e.stride;if(s!==e.byteLength)throw new o(`surfels.ply has ${e.byteLength} bytes; its header asks for ${s}.`);return i}var ae=class{element;name;count;view;constructor(e,t,n){this.element=t,this.name=n,this.count=t.count,this.view=new DataView(e,t.start,t.count*t.stride)}has(e){return this.element.columns.has(e)}into(e,t,n,r){let i=this.element.columns.get(e),a=t instanceof Float32Array?`float`:`int`;if(!i||i.type!==a)throw new o(`surfels.ply: ${this.name} has no property ${e} of type ${a}.`);let s=this.element.stride;for(let e=0,o=i.at,c=n;e<this.count;e++,o+=s,c+=r)t[c]=a===`float`?this.view.getFloat32(o,!0):this.view.getInt32(o,!0)}width(e){let t=0;for(;this.has(`${e}_${t}`);)t++;return t}},oe=`bitymi-bundle`,se={"1.4":[`surfels.ply`],"2.3":[`surfels.ply`],"4.0":[`surfels.ply`],"5.0":[`surfels.bin`]},ce={"surfels.count":[0,2147483647],"surfels.sites":[0,2147483647],"surfels.terms":[0,2147483647],"frame.center":[-1e9,1e9],"frame.scale":[5e-324,1e9],"frame.low":[-100,100],"columns.step":[1e-12,1e6],"columns.bytes":[0,1099511627776],"atlas.texels":[0,2147483647],"atlas.step":[1e-6,100],"atlas.page_width":[1,1048576],"atlas.page_rows":[1,1048576],"atlas.width":[1,1048576],"atlas.height":[1,1048576],"atlas.layers":[1,1048576],"atlas.extent":[1e-6,16],"atlas.offset":[-256,256],"atlas.scale":[5e-324,512],"atlas.alpha_scale":[5e-324,2],"atlas.clipped_fraction":[0,1],"atlas.psnr":[-1e3,1e3],"render.near":[1e-9,1e6],"render.weight_bound":[0,1],"render.background":[0,1],"bounds.min":[-1e9,1e9],"bounds.max":[-1e9,1e9],"world.transform":[-1e9,1e9],"world.scale":[5e-324,0xe8d4a51000],"world.up":[-2,2],"world.metres_per_unit":[5e-324,0xe8d4a51000],"files.bytes":[0,68719476736]},x={mean:0,opacityLogit:3,quat:4,logScale:8,betaRaw:10,extent:11,residual:12,layer:15,base:16,firstTerm:19,tile:20,sides:22,terms:23},S={rotation:0,center:12,alphaScale:15,colorCenter:16,depthUnit:19,lens:20,size:24,near:26,weightBound:27,offset:28,scale:29,atlas:30,surfels:32,kind:33,layers:34,show:35,residuals:36,photoPixel:37,detail:38},le={x:[0,null],y:[1,null],z:[2,null],rot_0:[4,null],rot_1:[5,null],rot_2:[6,null],rot_3:[7,null],scale_0:[8,null],scale_1:[9,null],opacity:[3,null],beta:[10,null]},ue={sv:0,"sv sites":1,sh:2,sb:3,sg:4},C={sv:6,sh:3,sb:6,sg:7},de={sv:[2e7,2e7,2e7,256,256,256],sh:[256,256,256],sb:[256,256,256,1e4,1e4,1e4],sg:[1e6,1e6,1e6,1e4,256,256,256],"sv sites":[1e6,1e6,1e6,1e4,256,256,256]},fe={sv:{parts:{sv_sites:3,sv_log_tau:1,sv_rgb:3},base:null,kind:1},sh:{parts:{sh_rest:3},base:`sh_dc`,kind:2},sb:{parts:{sb_lobes:6},base:`sb_base`,kind:3},sg:{parts:{sg_lobes:7},base:`sg_base`,kind:4}},pe={means:[0,3,1e9],log_scales:[8,2,104],opacity_logits:[3,1,1e4],beta_raw:[10,1,1e4],mean_residual:[12,3,256],view_base:[16,3,256]},me=[1e-6,16],he=1024,ge=e=>Math.min(Math.round(128*e),255)<<24>>>0,_e=({bounds:e})=>e.min.map((t,n)=>(t+e.max[n])/2);function ve(e,t){for(let n=x.mean;n<e.length;n+=24)for(let r=0;r<3;r++)e[n+r]-=t[r]}function ye(e,t,n){let[r,i,a,o,s]=n,c=new Uint32Array(e.buffer,4*t*24,24);c.set([r,i,o|s<<16],x.tile),c[x.layer]=a}function be(e,t,n){let r=new Uint32Array(e.buffer),i=0;for(let e=0,a=0;e<t.length;e++,a+=24)r[a+x.firstTerm]=i*n,r[a+x.terms]=t[e],i+=t[e];return i}function xe(e,t,n,r){let i=C[r];for(let t=0;t<3;t++)e.into(`view_base_${t}`,n,x.base+t,24);let a=new Int32Array(e.count);e.into(`view_terms`,a,0,1);let s=a.findIndex(e=>e<0||e>32);if(s>=0)throw new o(`surfels.ply: view_terms is wrong in row ${s}.`);if(be(n,a,i)!==t.count)throw new o(`surfels.ply: view_terms does not count the rows of view_term.`);let c=new Float32Array(t.count*i);for(let e=0;e<i;e++)t.into(`term_${e}`,c,e,i);return c}function Se(e,t,n,r){let i=n.reduce((e,[,t])=>e+t,0),a=e.width(n[0][0])/n[0][1];if(n.some(([t,n])=>e.width(t)!==a*n))throw new o(`surfels.ply: the columns of the view colour do not fit together.`);let s=new Float32Array(e.count*a*i),c=0;for(let[t,r]of n){for(let n=0;n<a;n++)for(let o=0;o<r;o++)e.into(`${t}_${n*r+o}`,s,n*i+c+o,a*i);c+=r}if(r!==null)for(let n=0;n<3;n++)e.into(`${r}_${n}`,t,x.base+n,24);return be(t,new Uint32Array(e.count).fill(a),i),s}function Ce(e,t,n){let r=[`tile_x`,`tile_y`,`tile_layer`,`tile_ru`,`tile_rv`].map(t=>{let n=new Int32Array(e.count);return e.into(t,n,0,1),n}),[i,a,s]=n.atlas?[n.atlas.width,n.atlas.height,n.atlas.layers]:[0,0,1];for(let n=0;n<e.count;n++){let[e,c,l,u,d]=r.map(e=>e[n]);if(!(e>=0&&c>=0&&u>=0&&d>=0&&e+u<=i&&c+d<=a)||l<0||l>=s||u>0!=d>0)throw new o(`surfels.ply: the tile of surfel ${n} lies outside the atlas.`);ye(t,n,[e,c,l,u,d])}}function we(e,t){let n=new Uint32Array(t.buffer),r=new Float32Array(e.count);e.into(`alpha`,r,0,1),r.forEach((e,t)=>{if(!(e>=0&&e<=2))throw new o(`surfels.ply: alpha is not from 0 to 2 in row ${t}.`);n[t*24+x.layer]|=ge(e)})}function Te(e,t,n){let r=(e,t)=>{throw new o(`surfels.ply: ${e} is beyond its limit, or no number, in row ${t}.`)};for(let t=0,n=0;n<e.length;t++,n+=24){for(let[i,[a,o,s]]of Object.entries(pe))for(let c=a;c<a+o;c++)Math.abs(e[n+c])<=s||r(i,t);let i=e[n+x.extent];i>=me[0]&&i<=me[1]||r(`tile_extent`,t);let a=Math.hypot(...e.subarray(n+x.quat,n+x.quat+4));if(!(Math.abs(a-1)<=.01))throw new o(`surfels.ply: rot_0 to rot_3 are not of length 1 in row ${t}.`)}let i=n.length,a=t.findIndex((e,t)=>!(Math.abs(e)<=n[t%i]));a>=0&&r(`a view colour`,Math.floor(a/i))}function Ee(e,t){let n=ie(e),r=n.get(`vertex`);if(!r||r.count!==t.count)throw new o(`surfels.ply has not the ${t.count} surfels of bundle.json.`);let i=new ae(e,r,`vertex`),a=new Float32Array(i.count*24),s=(e,t)=>i.into(e,a,t,24),c=(e,t)=>{for(let n=e;n<a.length;n+=24)a[n]=t};for(let[e,[t,n]]of Object.entries(le))n===null||i.has(e)?s(e,t):c(t,n);i.has(`tile_extent`)?s(`tile_extent`,x.extent):c(x.extent,t.atlas?.extent??3);let l=i.has(`residual_0`);l&&[0,1,2].forEach(e=>s(`residual_${e}`,x.residual+e)),Ce(i,a,t),t.atlas?.alphaScale&&we(i,a);let u=n.get(`view_term`),d=fe[t.viewColor],f=u?xe(i,new ae(e,u,`view_term`),a,t.viewColor):Se(i,a,Object.entries(d.parts),d.base);Te(a,f,de[t.viewColor===`sv`&&!u?`sv sites`:t.viewColor]);let p=_e(t);return ve(a,p),{count:i.count,words:a,terms:f,kind:u?ue[t.viewColor]:d.kind,origin:p,means:l}}var w=(e,t)=>[e[0]+t[0],e[1]+t[1],e[2]+t[2]],T=(e,t)=>[e[0]-t[0],e[1]-t[1],e[2]-t[2]],E=(e,t)=>[e*t[0],e*t[1],e*t[2]],D=(e,t)=>e[0]*t[0]+e[1]*t[1]+e[2]*t[2],O=(e,t)=>[e[1]*t[2]-e[2]*t[1],e[2]*t[0]-e[0]*t[2],e[0]*t[1]-e[1]*t[0]],k=e=>Math.hypot(...e),A=e=>E(1/Math.max(k(e),1e-12),e);function De(e,t,n){let[r,i]=[Math.cos(n),Math.sin(n)];return w(w(E(r,e),E(i,O(t,e))),E((1-r)*D(t,e),t))}var j=([e,t,n,r],[i,a,o,s])=>[e*i-t*a-n*o-r*s,e*a+t*i+n*s-r*o,e*o-t*s+n*i+r*a,e*s+t*o-n*a+r*i];function M(e){let t=k(e);return[Math.cos(t),...E(t>1e-9?Math.sin(t)/t:1,e)]}function Oe(e,t){let[n,r,i,a]=j([e[0],-e[1],-e[2],-e[3]],t),o=Math.hypot(r,i,a),s=n<0?-1:1;return E(o>1e-9?s*Math.atan2(o,Math.abs(n))/o:s,[r,i,a])}var ke=(e,t,n)=>j(e,M(E(n,Oe(e,t))));function N({right:e,down:t,forward:n}){let r=[1+e[0]+t[1]+n[2],1+e[0]-t[1]-n[2],1-e[0]+t[1]-n[2],1-e[0]-t[1]+n[2]],i=r.indexOf(Math.max(...r)),[a,o,s]=[t[2]-n[1],n[0]-e[2],e[1]-t[0]],[c,l,u]=[t[0]+e[1],n[0]+e[2],n[1]+t[2]],d=[[r[0],a,o,s],[a,r[1],c,l],[o,c,r[2],u],[s,l,u,r[3]]],f=1/Math.hypot(...d[i]);return d[i].map(e=>f*e)}var P=([e,t,n,r])=>[[1-2*(n*n+r*r),2*(t*n+e*r),2*(t*r-e*n)],[2*(t*n-e*r),1-2*(t*t+r*r),2*(n*r+e*t)],[2*(t*r+e*n),2*(n*r-e*t),1-2*(t*t+n*n)]];function Ae(e){let t=A(e),n=A(O(t,Math.abs(t[0])<.9?[1,0,0]:[0,1,0]));return N({position:[0,0,0],right:n,down:O(t,n),forward:t})}function je(e,t){let[n,r,i]=P(t);return{position:e,right:n,down:r,forward:i}}var F=({crop:e,hidden:t})=>!!(e.box??e.floor)||t.length>0;function Me({crop:{box:e,floor:t},hidden:n}){let r=e=>{let t=P(e.quat);return n=>{let r=T(n,e.center);return t.every((t,n)=>Math.abs(D(t,r))<=e.half[n])}},[i,a]=[e&&r(e),n.map(r)];return e=>!(i&&!i(e))&&!(t&&D(t.normal,e)<t.offset)&&!a.some(t=>t(e))}function Ne({words:e,count:t,origin:n},r){let i=Me(r),a=new Uint8Array(t);for(let r=0,o=x.mean;r<t;r++,o+=24)a[r]=Number(i([e[o]+n[0],e[o+1]+n[1],e[o+2]+n[2]]));return a}var Pe=`// Returns the start of batch k of \`layers\` in the sorted list of \`count\` visible surfels.
fn layer_begin(count: u32, k: u32, layers: u32) -> u32 {
  return count / layers * k + min(k, count % layers);
}
`,Fe=`// Screen rectangles that bound a surfel: the level set sigma = 1/255 of the kernel and of the low pass. As
// core/footprint.h, but along the axes of the surfel's image: a long thin surfel then costs only its own area.

struct Rectangle {
  visible: bool,
  axis: vec2f,
  middle: vec2f,  // pixels
  half_size: vec2f,
}

const BOUND_PAD: f32 = 0.02;  // pixels
const WIDEST: f32 = 1e5;  // pixels; larger surfels cover the whole screen
const LEAST_ANGLE: f32 = 1e-6;  // between the lines U = 0 and V = 0; below, the disc's image is lost to rounding

// Squared radius in scale units where the kernel is exp(-level) of its maximum, slightly enlarged.
fn level_radius2(level: f32, beta: f32) -> f32 {
  return SUPPORT2 * min(1.0, (1.0 - exp(-level / max(beta, 1e-6))) * 1.0002 + 4e-6);
}

// Major axis of the ellipse [p q] (unit circle).
fn major_axis(p: vec2f, q: vec2f) -> vec2f {
  let angle = 0.5 * atan2(2.0 * (p.x * p.y + q.x * q.y), p.x * p.x + q.x * q.x - p.y * p.y - q.y * q.y);
  return vec2f(cos(angle), sin(angle));
}

// Extent of the disc's image along \`e\`: x = P.q / (1 + C.q) on the unit disc, \`rest\` = 1 - |C|^2.
fn reach(e: vec2f, p: vec2f, q: vec2f, c: vec2f, rest: f32) -> vec2f {
  let along = vec2f(dot(e, p), dot(e, q));
  let pc = dot(along, c);
  let h = sqrt(pc * pc + rest * dot(along, along));
  return vec2f(-pc - h, h - pc) / rest;
}

fn hidden() -> Rectangle {
  return Rectangle(false, vec2f(0.0), vec2f(0.0), vec2f(0.0));
}
fn screen() -> Rectangle {
  return Rectangle(true, vec2f(1.0, 0.0), 0.5 * frame.size, 0.5 * frame.size);
}

// Builds the rectangle from \`low\` to \`high\` along an axis and across it, offsets from the projected centre.
fn finish(center: vec2f, axis: vec2f, low: vec2f, high: vec2f) -> Rectangle {
  let half_size = 0.5 * (high - low) * 1.0002 + BOUND_PAD;
  if !(max(half_size.x, half_size.y) < WIDEST) { return screen(); }
  let middle = 0.5 * (low + high);
  return Rectangle(true, axis, center + axis * middle.x + vec2f(-axis.y, axis.x) * middle.y, half_size);
}

// Whether the visible part of a disc lies beyond a border of the image: core/bounds.h.
fn beyond_border(along: vec2f, c: vec2f, border: f32) -> bool {
  let off = along - border * c;
  let far = abs(border);
  let room = far - 1e-5 * (abs(along.x) + abs(along.y) + far * (abs(c.x) + abs(c.y)));
  return room > 0.0 && dot(off, off) < room * room;
}

const CORNERS: u32 = 8;  // of a polygon about the disc
const MOST_CORNERS: u32 = CORNERS + 5;  // each plane adds one

// Clips a polygon around the disc to \`near\` and the image, and adds the low pass: for discs across the camera's plane,
// whose image is no ellipse, and for ellipses larger than the screen.
fn clipped(s: Seen, p: vec2f, q: vec2f, c: vec2f, blur: f32) -> Rectangle {
  let border = select(-s.center, min(frame.size - s.center, vec2f(0.0)), s.center >= vec2f(0.0));
  var low = vec2f(-blur);
  var high = vec2f(blur);
  var count = CORNERS;
  if beyond_border(vec2f(p.x, q.x), c, border.x) || beyond_border(vec2f(p.y, q.y), c, border.y) { count = 0; }
  var corners: array<vec3f, MOST_CORNERS>;  // offset from the centre times depth, and depth, in units of the centre's
  for (var k = 0u; k < count; k++) {
    let turn = (f32(k) + 0.5) * 6.2831853 / f32(CORNERS);
    let at = 1.0824 * vec2f(cos(turn), sin(turn));  // 1 / cos(pi / 8)
    corners[k] = vec3f(at.x * p + at.y * q, 1.0 + dot(c, at));
  }
  let planes = array<vec4f, 5>(
    vec4f(0.0, 0.0, 1.0, -frame.near / s.z),
    vec4f(1.0, 0.0, s.center.x, 0.0),
    vec4f(-1.0, 0.0, frame.size.x - s.center.x, 0.0),
    vec4f(0.0, 1.0, s.center.y, 0.0),
    vec4f(0.0, -1.0, frame.size.y - s.center.y, 0.0),
  );
  for (var side = 0u; side < 5; side++) {
    let polygon = corners;
    let before = count;
    count = 0;
    for (var k = 0u; k < before; k++) {
      let here = polygon[k];
      let next = polygon[select(k + 1, 0, k + 1 == before)];
      let inner = dot(planes[side], vec4f(here, 1.0));
      let after = dot(planes[side], vec4f(next, 1.0));
      if inner >= 0.0 {
        corners[count] = here;
        count++;
      }
      if (inner >= 0.0) != (after >= 0.0) && count < MOST_CORNERS {
        corners[count] = here + inner / (inner - after) * (next - here);
        count++;
      }
    }
  }
  if count > 0 && blur == 0.0 {  // the centre does not count
    low = vec2f(1e9);
    high = -low;
  }
  for (var k = 0u; k < count; k++) {
    let depth = corners[k].z;
    let at = corners[k].xy / depth;
    // rounding error: differences of the disc's axes, divided by a possibly small depth
    let lost = 5e-7 * (abs(p) + abs(q) + abs(at) * (abs(c.x) + abs(c.y) + 1.0)) / depth;
    low = min(low, at - 0.5 - lost);
    high = max(high, at + 0.5 + lost);
  }
  var r = finish(s.center, vec2f(1.0, 0.0), low, high);
  r.visible = count > 0 || blur > 0.0;
  return r;
}

fn rectangle(s: Seen) -> Rectangle {
  let ratio = s.opacity / ALPHA_MIN;
  let blurred = s.low_pass * ratio;  // maximum of the low pass over ALPHA_MIN
  let almost = 1.0 - 1e-6;
  if max(ratio, blurred) < almost { return hidden(); }
  let r2 = level_radius2(log(max(ratio, 1.0)) + 1e-5, s.beta);
  // if the kernel exceeds the low pass everywhere, the latter needs no extra pixels
  let blur2 = 1.0 / low_pass_sharp();
  let change = LOW_PASS_REACH * sqrt(blur2) * (abs(s.w.x) + abs(s.w.y));
  let least = s.w0 - change;
  let slope = dot(s.u, s.u) + dot(s.v, s.v);
  let covered = s.low_pass <= 1.0 && least > 0.0 && s.w0 * s.z > frame.near * (s.w0 + change)
    && SUPPORT2 * least * least >= (s.beta + LOW_PASS_REACH * LOW_PASS_REACH) * blur2 * 1.001 * slope;
  var blur = 0.0;
  if !covered && blurred >= almost { blur = sqrt((log(max(blurred, 1.0)) + 1e-5) * blur2) + 0.01; }
  if !(s.w0 > 0.0) {  // seen exactly edge-on: no ray hits it
    return finish(s.center, vec2f(1.0, 0.0), vec2f(-blur), vec2f(blur));
  }
  let mu = 1.0 / max(abs(s.u.x), abs(s.u.y));
  let mv = 1.0 / max(abs(s.v.x), abs(s.v.y));
  let u = s.u * mu;
  let v = s.v * mv;
  let det = u.x * v.y - u.y * v.x;
  if !(abs(det) > LEAST_ANGLE) { return screen(); }
  let wide = sqrt(r2) * (1.0001 + 1e-6 / abs(det)) / det;
  let p = s.w0 * mu * wide * vec2f(v.y, -v.x);
  let q = s.w0 * mv * wide * vec2f(-u.y, u.x);
  let c = vec2f(s.w.y * v.x - s.w.x * v.y, s.w.x * u.y - s.w.y * u.x) * vec2f(mu, mv) * wide;
  let rest = 1.0 - dot(c, c);
  if !(dot(p, p) + dot(q, q) < 1e12) { return screen(); }
  if !(rest > 1e-3) { return clipped(s, p, q, c, blur); }
  let axis = major_axis(p, q);
  let along = reach(axis, p, q, c, rest);
  let across = reach(vec2f(-axis.y, axis.x), p, q, c, rest);
  let low = min(vec2f(along.x, across.x), vec2f(-blur));
  let high = max(vec2f(along.y, across.y), vec2f(blur));
  let r = finish(s.center, axis, low, high);
  if max(r.half_size.x, r.half_size.y) < max(frame.size.x, frame.size.y) { return r; }
  let cut = clipped(s, p, q, c, blur);
  if !cut.visible || cut.half_size.x * cut.half_size.y < r.half_size.x * r.half_size.y { return cut; }
  return r;
}

fn on_screen(r: Rectangle) -> bool {
  let box = abs(r.axis) * r.half_size.x + abs(r.axis.yx) * r.half_size.y;
  return r.visible && all(r.middle + box >= vec2f(0.0)) && all(r.middle - box <= frame.size);
}
`,Ie=`// Draws a batch of surfels, nearest first, as rectangles into a target with the sums of a pixel and, in alpha, the
// remaining transmittance. Blending does the rest of core/blend.h:
//   sums += transmittance * (sigma * color),   transmittance *= 1 - sigma.
//
// Blending does not expose a fragment's weight: tests of it (bound of residual and alpha, end of a pixel) use the
// transmittance before the batch, an upper bound that more batches tighten. docs/viewer.md has the image error.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> surfels: array<Surfel>;
@group(0) @binding(2) var<storage, read> seen: array<Seen>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> visible: u32;
@group(1) @binding(0) var atlas: texture_2d_array<f32>;
@group(1) @binding(1) var bilinear: sampler;
@group(1) @binding(2) var coarser: texture_2d_array<f32>;  // levels 1 and 2 of the tiles, as its levels 0 and 1
@group(2) @binding(0) var<uniform> layer: vec4u;  // x: batch
@group(2) @binding(1) var before: texture_2d<f32>;  // target before this batch

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) @interpolate(flat) center_u: vec4f,
  @location(1) @interpolate(flat) v_w: vec4f,
  @location(2) @interpolate(flat) w0_z_opacity_beta: vec4f,
  @location(3) @interpolate(flat) color_low_pass: vec4f,
  @location(4) @interpolate(flat) tile: vec4f,  // first texel, span; without a tile residual and alpha
  @location(5) @interpolate(flat) texel: vec4f,  // layer, -1 without a tile; 1 / (2 extent); normal z; level
}

@vertex
fn corner(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Corner {
  let i = order[layer_begin(visible, layer.x, frame.layers) + instance];
  let s = seen[i];
  let surfel = surfels[i];
  let side = vec2f(f32(vertex & 1) * 2.0 - 1.0, f32(vertex >> 1) * 2.0 - 1.0);
  let offset = side * s.half_size;
  let pixel = s.middle + s.axis * offset.x + vec2f(-s.axis.y, s.axis.x) * offset.y;
  let at = (pixel / frame.size * 2.0 - 1.0) * vec2f(1.0, -1.0);
  var out: Corner;
  out.position = vec4f(at, 0.0, 1.0);
  out.center_u = vec4f(s.center, s.u);
  out.v_w = vec4f(s.v, s.w);
  out.w0_z_opacity_beta = vec4f(s.w0, s.z, s.opacity, s.beta);
  out.color_low_pass = vec4f(s.color, s.low_pass);
  if s.level == TILE_LEVELS {
    out.tile = vec4f(surfel.residual, f32(surfel.layer >> 24) / 128.0);
    out.texel = vec4f(-1.0, 0.0, s.normal_z, 0.0);
  } else {
    let sides = vec2u(surfel.sides & 0xffff, surfel.sides >> 16) >> vec2u(s.level);
    out.tile = vec4f(vec2f(surfel.tile >> vec2u(s.level)), vec2f(sides) - 1.0);
    out.texel = vec4f(f32(surfel.layer & 0xffffff), 0.5 / surfel.extent, s.normal_z, f32(s.level));
  }
  return out;
}

struct Fragment {
  at: vec2f,  // u, v
  depth: f32,
  sigma: f32,
}

// core/kernel.h
fn beta_fragment(c: Corner, d: vec2f) -> Fragment {
  let w0 = c.w0_z_opacity_beta.x;
  let z = c.w0_z_opacity_beta.y;
  let w = w0 + dot(c.v_w.zw, d);
  let hit = w > 0.0 && w0 * z > frame.near * w;
  let inverse = 1.0 / select(1.0, w, hit);
  let at = select(vec2f(0.0), vec2f(dot(c.center_u.zw, d), dot(c.v_w.xy, d)) * inverse, hit);
  let rest = 1.0 - dot(at, at) / SUPPORT2;
  let inside = hit && rest > 0.0;
  let kernel = select(0.0, exp2(c.w0_z_opacity_beta.w * log2(select(1.0, rest, inside))), inside);
  let blur = c.color_low_pass.w * exp(-dot(d, d) * low_pass_sharp());
  var f: Fragment;
  f.at = clamp(at, vec2f(-SUPPORT), vec2f(SUPPORT));
  f.depth = select(w0 * z * inverse, z, blur > kernel);
  f.sigma = min(ALPHA_MAX, c.w0_z_opacity_beta.z * max(kernel, blur));
  return f;
}

// Fetches the residual and the factor of sigma.
fn texels(c: Corner, at: vec2f) -> vec4f {
  if c.texel.x < 0.0 { return c.tile; }
  let span = c.tile.zw;
  let texel = c.tile.xy + clamp(at * (span + 1.0) * c.texel.y + 0.5 * span, vec2f(0.0), span) + 0.5;
  let layer = u32(c.texel.x);
  var stored: vec4f;
  if c.texel.w == 0.0 {
    stored = textureSampleLevel(atlas, bilinear, texel / frame.atlas, layer, 0.0);
  } else {
    let level = c.texel.w - 1.0;
    stored = textureSampleLevel(coarser, bilinear, texel / vec2f(textureDimensions(coarser, u32(level))), layer, level);
  }
  return vec4f(frame.offset + frame.scale * stored.rgb, frame.alpha_scale * stored.a);
}

@fragment
fn surfel(c: Corner) -> @location(0) vec4f {
  let d = c.position.xy - c.center_u.xy;
  var f = beta_fragment(c, d);
  if f.sigma < ALPHA_MIN { discard; }
  var front = 1.0;
  if layer.x > 0 { front = textureLoad(before, vec2i(c.position.xy), 0).a; }
  if front < TRANSMITTANCE_MIN { discard; }
  var texel = vec4f(0.0);
  let cut = frame.alpha_scale > 0.0 && f.sigma * front >= frame.weight_bound;
  if cut {
    texel = texels(c, f.at);
    f.sigma = min(ALPHA_MAX, f.sigma * texel.a);
    if f.sigma < ALPHA_MIN { discard; }
  }
  let colored = frame.residuals != 0 && (frame.show == SHOW_COLOR || frame.show == SHOW_RESIDUAL);
  let textured = colored && f.sigma * front >= frame.weight_bound;
  if textured && !cut { texel = texels(c, f.at); }
  switch frame.show {
    case SHOW_DEPTH: { return vec4f(f.sigma * (f.depth / frame.depth_unit), f.sigma * c.w0_z_opacity_beta.w, f.sigma, f.sigma); }
    case SHOW_NORMAL: {
      return vec4f(f.sigma * vec3f(-c.v_w.zw * frame.lens.xy, c.texel.z), f.sigma);
    }
    case SHOW_OVERDRAW: { return vec4f(1.0, 0.0, 0.0, f.sigma); }
    case SHOW_RESIDUAL: {
      var shift = vec3f(0.0);
      if textured { shift = texel.rgb; }
      return vec4f(f.sigma * max(shift + 0.5, vec3f(0.0)), f.sigma);
    }
    default: {
      var color = c.color_low_pass.xyz;
      if textured { color = max(color + texel.rgb, vec3f(0.0)); }
      return vec4f(f.sigma * color, f.sigma);
    }
  }
}
`,Le=`// Halves a page of an atlas: means of 2 x 2 texels, as \`ops.tile_levels\`. With alpha, colours are weighted by it unless
// all four are 0: transparent texels do not tint their neighbours.

@group(0) @binding(0) var finer: texture_2d<f32>;

@vertex
fn page(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(f32(vertex & 1) * 4.0 - 1.0, f32(vertex >> 1) * 4.0 - 1.0, 0.0, 1.0);
}

fn texels(position: vec4f) -> array<vec4f, 4> {
  let at = 2 * vec2i(position.xy);
  return array<vec4f, 4>(
    textureLoad(finer, at, 0), textureLoad(finer, at + vec2i(1, 0), 0), textureLoad(finer, at + vec2i(0, 1), 0),
    textureLoad(finer, at + vec2i(1, 1), 0),
  );
}
fn sum(t: array<vec4f, 4>) -> vec4f {
  return t[0] + t[1] + t[2] + t[3];
}
fn weighted(t: array<vec4f, 4>) -> vec3f {
  return t[0].a * t[0].rgb + t[1].a * t[1].rgb + t[2].a * t[2].rgb + t[3].a * t[3].rgb;
}

// Averages bytes, rounded.
fn bytes(t: array<vec4f, 4>) -> vec4f {
  return floor((round(sum(t) * 255.0) + 2.0) / 4.0) / 255.0;
}
@fragment
fn halve_bytes(@builtin(position) position: vec4f) -> @location(0) vec4f {
  return bytes(texels(position));
}
@fragment
fn halve_alpha_bytes(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let t = texels(position);
  let mean = bytes(t);
  let total = u32(round(sum(t).a * 255.0));
  if total == 0 { return mean; }
  let colors = (vec3u(round(weighted(t) * 65025.0)) + total / 2) / total;
  return vec4f(vec3f(colors) / 255.0, mean.a);
}

@fragment
fn halve_floats(@builtin(position) position: vec4f) -> @location(0) vec4f {
  return sum(texels(position)) / 4.0;
}
@fragment
fn halve_alpha_floats(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let t = texels(position);
  let mean = sum(t) / 4.0;
  if mean.a == 0.0 { return mean; }
  return vec4f(weighted(t) / (4.0 * mean.a), mean.a);
}
`,Re=`// Computes projection, view colour, bounding rectangle and sort key, one thread per surfel.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> surfels: array<Surfel>;
@group(0) @binding(3) var<storage, read_write> seen: array<Seen>;
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> order: array<u32>;
@group(0) @binding(6) var<storage, read_write> visible: atomic<u32>;

const HIDDEN: u32 = 0xffffffff;

fn to_camera(a: vec3f) -> vec3f {
  return vec3f(dot(frame.rotation[0].xyz, a), dot(frame.rotation[1].xyz, a), dot(frame.rotation[2].xyz, a));
}

fn finite(x: vec4f) -> bool {
  return all(abs(x) < vec4f(3e38));
}

@compute @workgroup_size(64)
fn prepare(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if i >= frame.surfels { return; }
  order[i] = i;
  keys[i] = HIDDEN;
  let surfel = surfels[i];
  let p = to_camera(surfel.mean - frame.center);
  if !(p.z > frame.near) { return; }

  let h = surfel.quat;  // w, x, y, z of unit length
  let t_u = vec3f(1.0 - 2.0 * (h.z * h.z + h.w * h.w), 2.0 * (h.y * h.z + h.x * h.w), 2.0 * (h.y * h.w - h.x * h.z));
  let t_v = vec3f(2.0 * (h.y * h.z - h.x * h.w), 1.0 - 2.0 * (h.y * h.y + h.w * h.w), 2.0 * (h.z * h.w + h.x * h.y));
  let t_n = vec3f(2.0 * (h.y * h.w + h.x * h.z), 2.0 * (h.z * h.w - h.x * h.y), 1.0 - 2.0 * (h.y * h.y + h.z * h.z));
  let a = to_camera(t_u);
  let b = to_camera(t_v);
  let n = to_camera(t_n);
  let np = dot(n, p);
  let turn = select(1.0, -1.0, np < 0.0);
  let iz = 1.0 / p.z;
  let inverse_focal = 1.0 / frame.lens.xy;
  let scales = exp(clamp(surfel.log_scale, vec2f(-LOG_SCALE_MAX), vec2f(LOG_SCALE_MAX)));

  var s: Seen;
  s.center = frame.lens.xy * p.xy * iz + frame.lens.zw;
  s.u = -turn * cross(p, b).xy * inverse_focal / scales.x;
  s.v = turn * cross(p, a).xy * inverse_focal / scales.y;
  s.w0 = turn * np * iz;
  s.w = turn * n.xy * inverse_focal;
  s.z = p.z;
  s.opacity = sigmoid(surfel.opacity_logit);
  s.beta = BETA_MAX * sigmoid(surfel.beta_raw);
  s.normal_z = -turn * n.z;
  s = resized(s);
  if !finite(vec4f(s.center, s.w0, s.low_pass)) || !finite(vec4f(s.opacity)) || !finite(vec4f(s.u, s.v)) { return; }

  let r = rectangle(s);
  if !on_screen(r) { return; }
  s.axis = r.axis;
  s.middle = r.middle;
  s.half_size = r.half_size;
  let direction = unit(surfel.mean - frame.color_center);
  s.level = tile_level(s, surfel);
  s.color = max(view_color(frame.kind, surfel, direction) + COLOR_BIAS, vec3f(0.0));
  seen[i] = s;
  keys[i] = bitcast<u32>(p.z);  // positive floats sort like their bits
  atomicAdd(&visible, 1u);
}
`,ze=`// Presents the sums of draw.wgsl on the screen: over the background, or as a colour map.

struct Screen {
  background: vec4f,
  size: vec2f,  // viewport, pixels
  show: u32,  // SHOW_*
  most: f32,  // upper end of a map's range
  pixels: vec2f,  // size of the view
  first: vec2u,  // top left pixel of the part that was rendered; nothing covers the others
  samples: u32,  // per pixel and axis
  correction: array<vec4f, 3>,  // rows of [matrix | offset] of colours, as train.views.shown
}

@group(0) @binding(0) var<uniform> screen: Screen;
@group(0) @binding(1) var sums: texture_2d<f32>;
@group(0) @binding(2) var smooth_sampler: sampler;

@vertex
fn whole(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(f32(vertex & 1) * 4.0 - 1.0, f32(vertex >> 1) * 4.0 - 1.0, 0.0, 1.0);
}

// Maps 0 to 1 to dark blue, green, yellow, red.
fn ramp(x: f32) -> vec3f {
  let t = clamp(x, 0.0, 1.0);
  let stops = array<vec3f, 5>(
    vec3f(0.10, 0.10, 0.25), vec3f(0.13, 0.42, 0.62), vec3f(0.25, 0.68, 0.45), vec3f(0.93, 0.80, 0.30),
    vec3f(0.83, 0.22, 0.16),
  );
  let at = t * 4.0;
  let k = min(u32(at), 3u);
  return mix(stops[k], stops[k + 1], at - f32(k));
}

// Resamples the sums at a pixel: interpolated, or the mean of its samples.
fn drawn(position: vec2f) -> vec4f {
  if screen.samples <= 1 { return textureSampleLevel(sums, smooth_sampler, position / screen.size, 0.0); }
  let part = textureDimensions(sums) / screen.samples;
  let at = vec2u(position / screen.size * screen.pixels) - screen.first;  // from 2^32 down where it is less
  if any(at >= part) { return vec4f(0.0, 0.0, 0.0, 1.0); }
  let first = screen.samples * at;
  var total = vec4f(0.0);
  for (var y = 0u; y < screen.samples; y++) {
    for (var x = 0u; x < screen.samples; x++) { total += textureLoad(sums, first + vec2u(x, y), 0); }
  }
  return total / f32(screen.samples * screen.samples);
}

@fragment
fn present(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let s = drawn(position.xy);
  let covered = 1.0 - s.a;
  switch screen.show {
    case SHOW_DEPTH: {
      let depth = s.r / max(covered, 1e-4); // 1: the farthest
      return vec4f(mix(screen.background.rgb, ramp(1.0 - depth), covered), 1.0);
    }
    case SHOW_NORMAL: {
      let normal = s.rgb / max(covered, 1e-4);
      return vec4f(mix(screen.background.rgb, normal * 0.5 + 0.5, covered), 1.0);
    }
    case SHOW_OVERDRAW: { return vec4f(ramp(s.r / screen.most), 1.0); }
    default: {
      let seen = vec4f(s.rgb, covered);
      let rows = screen.correction;
      let corrected = vec3f(dot(rows[0], seen), dot(rows[1], seen), dot(rows[2], seen));
      return vec4f(corrected + s.a * screen.background.rgb, 1.0);
    }
  }
}
`,Be=`// Adaptation of surfels to views of another size than the photographs, as core/resize.h and core/texel.h.

// Variance that a pixel adds along each axis, pixels^2.
fn pixel_variance() -> f32 {
  let p = frame.photo_pixel;
  return max(0.0, (1.0 - p * p) / 12.0);
}
// 1 / squared radius of the low pass.
fn low_pass_sharp() -> f32 {
  let p = frame.photo_pixel;
  return 1.0 / (p * p + 2.0 * pixel_variance());
}

// Widens the surfel by the pixel and its low pass by the view's size; \`low_pass\` then holds the height of the low pass
// over that of the kernel.
fn resized(seen: Seen) -> Seen {
  var s = seen;
  let variance = pixel_variance();
  let p = frame.photo_pixel;
  let share = p * p * low_pass_sharp();
  s.low_pass = share;
  if variance == 0.0 || !(s.w0 > 0.0) { return s; }
  // M' = (1 + c M M^T)^(-1/2) M, from positive terms only
  let c = variance * 2.0 / SUPPORT2 * (s.beta + 2.0);
  let u = s.u / s.w0;
  let v = s.v / s.w0;
  let uu = c * dot(u, u);
  let uv = c * dot(u, v);
  let vv = c * dot(v, v);
  let across = c * (u.x * v.y - u.y * v.x);
  let root = sqrt(1.0 + uu + vv + across * across);
  let k = 1.0 / (root * sqrt(2.0 + uu + vv + 2.0 * root));
  let inverse = vec3f(1.0 + vv + root, -uv, 1.0 + uu + root) * k;
  s.u = inverse.x * seen.u + inverse.y * seen.v;
  s.v = inverse.y * seen.u + inverse.z * seen.v;
  s.opacity = seen.opacity / root;
  s.low_pass = share * root;
  return s;
}

// Selects the level of a tile with about one texel per pixel.
fn tile_level(s: Seen, surfel: Surfel) -> u32 {
  if surfel.sides == 0 || frame.detail == DETAIL_MEANS { return TILE_LEVELS; }
  let p = frame.photo_pixel;
  if !(p < 1.0) { return 0; }
  let sides = vec2u(surfel.sides & 0xffff, surfel.sides >> 16);
  let k = 0.5 / (surfel.extent * s.w0);
  let area = sqrt(dot(s.u, s.u) * dot(s.v, s.v)) * k * k * f32(sides.x) * f32(sides.y);  // texels per pixel
  let most = 1.0 / (p * p);
  var level = 0u;
  for (var size = 2.0; level < TILE_LEVELS && area > size && most >= size; size *= 4.0) { level++; }
  if level > 0 && (max(sides.x, sides.y) >> level) <= 2 {
    if frame.detail == DETAIL_ALL { return TILE_LEVELS; }
    return 0;
  }
  level = min(level, TILE_LEVELS - 1);
  let grid = surfel.tile.x | surfel.tile.y | sides.x | sides.y;
  while level > 0 && (grid & ((1u << level) - 1)) != 0 { level--; }
  return level;
}
`,Ve=`// Declarations shared by the shaders of a baked scene, which the browser viewer and \`ops.webgpu\` draw with. csrc/core
// explains their formulas.

const SUPPORT: f32 = 3.0;
const SUPPORT2: f32 = 9.0;
const ALPHA_MAX: f32 = 0.99;
const ALPHA_MIN: f32 = 0.00392156862745098;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const LOW_PASS_REACH: f32 = 2.36;
const BETA_MAX: f32 = 4.0;
const LOG_SCALE_MAX: f32 = 30.0;
const COLOR_BIAS: f32 = 0.5;

// A stored surfel, 96 bytes; means are relative to the scene's origin.
struct Surfel {
  mean: vec3f,
  opacity_logit: f32,
  quat: vec4f,  // wxyz, unit
  log_scale: vec2f,
  beta_raw: f32,
  extent: f32,  // half side of the tile, scale units
  residual: vec3f,  // without a tile
  layer: u32,  // of the tile, 24 bits; above, 128 times the alpha without a tile
  base: vec3f,  // base of the view colour
  first_term: u32,
  tile: vec2u,  // first texel
  sides: u32,  // texels along u, and along v in the upper half; 0: no tile
  terms: u32,
}

// A projected surfel, 96 bytes; core/surfel.h defines the planes U, V and W.
struct Seen {
  center: vec2f,  // pixels
  u: vec2f,
  v: vec2f,
  w: vec2f,  // w1, w2
  w0: f32,
  z: f32,
  opacity: f32,
  beta: f32,
  color: vec3f,  // relu(f_view + 0.5)
  low_pass: f32,  // its height over that of the kernel
  axis: vec2f,  // unit vector along the bounding rectangle
  middle: vec2f,  // of the rectangle, pixels
  half_size: vec2f,  // along the axis and across
  normal_z: f32,
  level: u32,  // of its tile; TILE_LEVELS: mean residual only
}

struct Frame {
  rotation: array<vec4f, 3>,  // rows, world to camera
  center: vec3f,  // camera centre relative to the scene's origin
  alpha_scale: f32,  // m = alpha_scale * a texel's alpha multiplies sigma; 0: opaque scene
  color_center: vec3f,  // viewpoint for view colours; \`center\` unless frozen
  depth_unit: f32,  // of blended depths, which half floats must hold
  lens: vec4f,  // fx, fy, cx, cy
  size: vec2f,  // pixels
  near: f32,
  weight_bound: f32,
  offset: f32,  // residual = offset + scale * texel
  scale: f32,
  atlas: vec2f,  // size of a page, texels
  surfels: u32,
  kind: u32,  // of the view colours, VIEW_*
  layers: u32,  // batches of surfels, drawn in sequence
  show: u32,  // SHOW_*
  residuals: u32,  // 1: add residuals
  photo_pixel: f32,  // side of a photograph's pixel in pixels of the view: resize.wgsl
  detail: u32,  // DETAIL_*: available residuals
}

const DETAIL_MEANS: u32 = 0;  // means only, texels are still loading
const DETAIL_TEXELS: u32 = 1;
const DETAIL_ALL: u32 = 2;

const TILE_LEVELS: u32 = 3;  // of a tile: texels, and means of 2 x 2 and 4 x 4

// Blended quantity, see draw.wgsl.
const SHOW_COLOR: u32 = 0;
const SHOW_DEPTH: u32 = 1;
const SHOW_NORMAL: u32 = 2;
const SHOW_OVERDRAW: u32 = 3;
const SHOW_RESIDUAL: u32 = 4;

fn sigmoid(x: f32) -> f32 {
  let e = exp(-abs(x));
  return select(1.0, e, x < 0.0) / (1.0 + e);
}
`,He=`// Divides the visible surfels, front to back, into batches of equal size and writes their draw arguments.

struct Draw {
  vertices: u32,
  instances: u32,
  first_vertex: u32,
  first_instance: u32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> visible: u32;
@group(0) @binding(2) var<storage, read_write> draws: array<Draw>;

@compute @workgroup_size(64)
fn share_out(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  if k >= frame.layers { return; }
  draws[k] = Draw(4, layer_begin(visible, k + 1, frame.layers) - layer_begin(visible, k, frame.layers), 0, 0);
}
`,Ue=`// Sorts (key, value) pairs stably by 4 bits of the key, lowest first; eight rounds sort completely. Each round has three
// kernels, as workgroups of one dispatch must not wait for each other: forward progress is not guaranteed.
//
//   count    histogram of digits per block of 1,024 keys
//   scan     first output position per digit and block
//   scatter  moves the pairs

const THREADS: u32 = 256;
const PER_THREAD: u32 = 4;
const BLOCK: u32 = 1024;
const DIGITS: u32 = 16;

struct Round {
  count: u32,
  blocks: u32,
  shift: u32,
  unused: u32,
}

@group(0) @binding(0) var<uniform> round: Round;
@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> table: array<u32>;  // by digit, then by block

var<workgroup> totals: array<atomic<u32>, DIGITS>;

@compute @workgroup_size(THREADS)
fn count(@builtin(local_invocation_index) thread: u32, @builtin(workgroup_id) group: vec3u) {
  if thread < DIGITS { atomicStore(&totals[thread], 0u); }
  workgroupBarrier();
  for (var k = 0u; k < PER_THREAD; k++) {
    let at = group.x * BLOCK + k * THREADS + thread;
    if at < round.count { atomicAdd(&totals[(keys_in[at] >> round.shift) & (DIGITS - 1)], 1u); }
  }
  workgroupBarrier();
  if thread < DIGITS { table[thread * round.blocks + group.x] = atomicLoad(&totals[thread]); }
}

var<workgroup> sums: array<u32, THREADS>;

// Scans the table in one workgroup; each thread takes a run.
@compute @workgroup_size(THREADS)
fn scan(@builtin(local_invocation_index) thread: u32) {
  let size = DIGITS * round.blocks;
  let run = (size + THREADS - 1) / THREADS;
  let begin = min(thread * run, size);
  let end = min(begin + run, size);
  var total = 0u;
  for (var i = begin; i < end; i++) { total += table[i]; }
  sums[thread] = total;
  for (var step = 1u; step < THREADS; step *= 2) {
    workgroupBarrier();
    var other = 0u;
    if thread >= step { other = sums[thread - step]; }
    workgroupBarrier();
    sums[thread] += other;
  }
  var before = sums[thread] - total;
  for (var i = begin; i < end; i++) {
    let size = table[i];
    table[i] = before;
    before += size;
  }
}

// 16-bit counters of 16 digits: digit d in half d % 2 of word d / 2.
struct Counts {
  low: vec4u,
  high: vec4u,
}
var<workgroup> counts: array<Counts, THREADS>;

fn one(digit: u32) -> Counts {
  let value = 1u << (16 * (digit & 1));
  let lanes = vec4u(0, 1, 2, 3) == vec4u((digit >> 1) & 3);
  let word = select(vec4u(0), vec4u(value), lanes);
  return Counts(select(vec4u(0), word, digit < 8), select(vec4u(0), word, digit >= 8));
}
fn of_digit(c: Counts, digit: u32) -> u32 {
  let words = select(c.high, c.low, digit < 8);
  return (words[(digit >> 1) & 3] >> (16 * (digit & 1))) & 0xffff;
}

@compute @workgroup_size(THREADS)
fn scatter(@builtin(local_invocation_index) thread: u32, @builtin(workgroup_id) group: vec3u) {
  let first = group.x * BLOCK + thread * PER_THREAD;
  var mine = Counts(vec4u(0), vec4u(0));
  for (var k = 0u; k < PER_THREAD; k++) {
    if first + k < round.count {
      let c = one((keys_in[first + k] >> round.shift) & (DIGITS - 1));
      mine = Counts(mine.low + c.low, mine.high + c.high);
    }
  }
  counts[thread] = mine;
  for (var step = 1u; step < THREADS; step *= 2) {
    workgroupBarrier();
    var other = Counts(vec4u(0), vec4u(0));
    if thread >= step { other = counts[thread - step]; }
    workgroupBarrier();
    counts[thread] = Counts(counts[thread].low + other.low, counts[thread].high + other.high);
  }
  var before = Counts(counts[thread].low - mine.low, counts[thread].high - mine.high);
  for (var k = 0u; k < PER_THREAD; k++) {
    if first + k >= round.count { break; }
    let key = keys_in[first + k];
    let digit = (key >> round.shift) & (DIGITS - 1);
    let to = table[digit * round.blocks + group.x] + of_digit(before, digit);
    keys_out[to] = key;
    values_out[to] = values_in[first + k];
    let c = one(digit);
    before = Counts(before.low + c.low, before.high + c.high);
  }
}
`,We=`// View colours f_view(d), without the offset 0.5, from a base and terms, as core/view_kinds.h.

const VIEW_SV: u32 = 0;  // reduced: b, rgb
const VIEW_SV_SITES: u32 = 1;  // all sites: site, log temperature, rgb
const VIEW_SH: u32 = 2;  // coefficients from degree 1 on: rgb
const VIEW_SB: u32 = 3;  // lobes: rgb, theta, phi, b
const VIEW_SG: u32 = 4;  // lobes: mu, log sharpness, rgb
const LOG_TAU_MAX: f32 = 16.0;
const LOG_POWER_MAX: f32 = 10.0;
const SH_C0: f32 = 0.28209479177387814;
const SH_C1: f32 = 0.4886025119029199;
const SH_C2A: f32 = 1.0925484305920792;
const SH_C2B: f32 = 0.31539156525252005;
const SH_C2C: f32 = 0.5462742152960396;
const SH_C3A: f32 = 0.5900435899266435;
const SH_C3B: f32 = 2.890611442640554;
const SH_C3C: f32 = 0.4570457994644658;
const SH_C3E: f32 = 0.3731763325901154;
const SH_C3F: f32 = 1.445305721320277;
const LOBE_SHARPNESS: f32 = 6.931471805599453;

@group(0) @binding(2) var<storage, read> terms: array<f32>;

fn term3(at: u32) -> vec3f {
  return vec3f(terms[at], terms[at + 1], terms[at + 2]);
}

fn unit(a: vec3f) -> vec3f {
  let big = max(abs(a.x), max(abs(a.y), abs(a.z)));
  if !(big > 1e-12) { return a * 1e12; }
  return normalize(a / big);
}

fn voronoi(s: Surfel, d: vec3f) -> vec3f {
  if s.terms == 0 { return s.base; }
  var top = 0.0;
  for (var k = 0u; k < s.terms; k++) { top = max(top, dot(term3(s.first_term + 6 * k), d)); }
  var total = exp(-top);
  var c = total * s.base;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 6 * k;
    let w = exp(dot(term3(at), d) - top);
    total += w;
    c += w * term3(at + 3);
  }
  return c / total;
}

fn voronoi_sites(s: Surfel, d: vec3f) -> vec3f {
  var top = -1e30;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 7 * k;
    top = max(top, exp(min(terms[at + 3], LOG_TAU_MAX)) * dot(unit(term3(at)), d));
  }
  var total = 0.0;
  var c = vec3f(0.0);
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 7 * k;
    let w = exp(exp(min(terms[at + 3], LOG_TAU_MAX)) * dot(unit(term3(at)), d) - top);
    total += w;
    c += w * term3(at + 4);
  }
  return c / total;
}

fn harmonics(s: Surfel, d: vec3f) -> vec3f {
  let x = d.x;
  let y = d.y;
  let z = d.z;
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  let at = s.first_term;
  var c = SH_C0 * s.base;
  if s.terms >= 3 {
    c += SH_C1 * (-y * term3(at) + z * term3(at + 3) - x * term3(at + 6));
  }
  if s.terms >= 8 {
    c += SH_C2A * (x * y * term3(at + 9) - y * z * term3(at + 12) - x * z * term3(at + 18));
    c += SH_C2B * (2.0 * zz - xx - yy) * term3(at + 15) + SH_C2C * (xx - yy) * term3(at + 21);
  }
  if s.terms >= 15 {
    c += -SH_C3A * y * (3.0 * xx - yy) * term3(at + 24) + SH_C3B * x * y * z * term3(at + 27);
    c += -SH_C3C * y * (4.0 * zz - xx - yy) * term3(at + 30);
    c += SH_C3E * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * term3(at + 33);
    c += -SH_C3C * x * (4.0 * zz - xx - yy) * term3(at + 36) + SH_C3F * z * (xx - yy) * term3(at + 39);
    c += -SH_C3A * x * (xx - 3.0 * yy) * term3(at + 42);
  }
  return c;
}

fn lobe_softplus(x: vec3f) -> vec3f {
  let a = LOBE_SHARPNESS * x;
  return (max(a, vec3f(0.0)) + log(1.0 + exp(-abs(a)))) / LOBE_SHARPNESS;
}

fn beta_lobes(s: Surfel, d: vec3f) -> vec3f {
  var c = s.base;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 6 * k;
    let theta = terms[at + 3];
    let phi = terms[at + 4];
    let cosine = dot(vec3f(sin(theta) * cos(phi), sin(theta) * sin(phi), cos(theta)), d);
    let power = 4.0 * exp(min(terms[at + 5], LOG_POWER_MAX));
    if cosine > 0.0 { c += exp(power * log(cosine)) * lobe_softplus(term3(at)); }
  }
  return c;
}

fn gaussians(s: Surfel, d: vec3f) -> vec3f {
  var c = s.base;
  for (var k = 0u; k < s.terms; k++) {
    let at = s.first_term + 7 * k;
    let sharp = exp(min(terms[at + 3], LOG_TAU_MAX));
    c += exp(sharp * (dot(unit(term3(at)), d) - 1.0)) * term3(at + 4);
  }
  return c;
}

fn view_color(kind: u32, s: Surfel, d: vec3f) -> vec3f {
  switch kind {
    case VIEW_SV: { return voronoi(s, d); }
    case VIEW_SV_SITES: { return voronoi_sites(s, d); }
    case VIEW_SH: { return harmonics(s, d); }
    case VIEW_SB: { return beta_lobes(s, d); }
    default: { return gaussians(s, d); }
  }
}
`,Ge={color:0,depth:1,normal:2,overdraw:3,residual:4},Ke=[`count`,`scan`,`scatter`],qe={operation:`add`,srcFactor:`zero`,dstFactor:`one-minus-src-alpha`},Je={blend:{operation:`add`,srcFactor:`dst-alpha`,dstFactor:`one`},count:{operation:`add`,srcFactor:`one`,dstFactor:`one`}},Ye=class{device;prepare;sort;shareOut;layouts;drawing;halving;presenting;made=new Map;constructor(e){this.device=e;let t=(t,...n)=>e.createShaderModule({label:t,code:n.join(`
`)}),n=(t,n)=>e.createComputePipeline({layout:`auto`,compute:{module:t,entryPoint:n}});this.prepare=n(t(`prepare`,Ve,We,Be,Fe,Re),`prepare`);let r=t(`sort`,Ue),i=Ke.map(e=>[e,n(r,e)]);this.sort=Object.fromEntries(i),this.shareOut=n(t(`share_out`,Ve,Pe,He),`share_out`),this.drawing=t(`draw`,Ve,Pe,Be,Ie),this.halving=t(`halve`,Le),this.presenting=t(`present`,Ve,ze),this.layouts=this.makeLayouts()}makeLayouts(){let{VERTEX:e,FRAGMENT:t}=GPUShaderStage,n=(...e)=>this.device.createBindGroupLayout({entries:e.map((e,t)=>({binding:t,...e}))}),r=n=>({visibility:e|t,buffer:{type:`uniform`,...n}}),i={visibility:e,buffer:{type:`read-only-storage`}},a={visibility:t,texture:{viewDimension:`2d-array`}};return[n(r({}),i,i,i,i),n(a,{visibility:t,sampler:{}},a),n(r({hasDynamicOffset:!0,minBindingSize:16}),{visibility:t,texture:{sampleType:`unfilterable-float`}})]}once(e,t){let n=this.made.get(e)??this.device.createRenderPipeline(t);return this.made.set(e,n),n}draw(e,t){return this.once(`draw ${e} ${t}`,{layout:this.device.createPipelineLayout({bindGroupLayouts:this.layouts}),vertex:{module:this.drawing,entryPoint:`corner`},primitive:{topology:`triangle-strip`},fragment:{module:this.drawing,entryPoint:`surfel`,targets:[{format:e,blend:{color:Je[t],alpha:qe}}]}})}halve(e,t){let n=`halve${t?`_alpha`:``}_${e===`rgba8unorm`?`bytes`:`floats`}`;return this.once(n,{layout:`auto`,vertex:{module:this.halving,entryPoint:`page`},fragment:{module:this.halving,entryPoint:n,targets:[{format:e}]}})}present(e){return this.once(`present ${e}`,{layout:`auto`,vertex:{module:this.presenting,entryPoint:`whole`},fragment:{module:this.presenting,entryPoint:`present`,targets:[{format:e}]}})}},Xe=e=>[e.fx,e.fy,e.cx,e.cy,e.width,e.height],Ze=e=>String(Number(e.toPrecision(9))),Qe=(e,t)=>{let n=(e??``).split(`,`).map(Number);return e!==null&&n.length===t&&n.every(Number.isFinite)?n:null};function $e({pose:e,lens:t,target:n,show:r,residuals:i}){let a=(e,t)=>`${e}=${t.map(Ze).join(`,`)}`,o=[a(`p`,e.position),a(`r`,[...e.right,...e.forward]),a(`t`,n),a(`l`,Xe(t))];return r!==`color`&&o.push(`show=${r}`),i||o.push(`texture=off`),`#${o.join(`&`)}`}var et=({pose:{position:e,right:t,forward:n},lens:r,target:i})=>({position:e,right:t,forward:n,target:i,lens:Xe(r)}),tt=1e9;function nt(e){let t=e??{},n=(e,t)=>Array.isArray(e)&&e.length===t&&e.every(e=>Number.isFinite(e)&&Math.abs(e)<=tt),{position:r,right:i,forward:a,target:o,lens:s}=t;if(![r,i,a,o].every(e=>n(e,3))||!n(s,6)||!s.every((e,t)=>t===2||t===3||e>0))return null;let[c,l]=[i,a];if(!(Math.abs(k(c)-1)<.001&&Math.abs(k(l)-1)<.001)||Math.abs(D(c,l))>.001)return null;let[u,d,f,p,m,h]=s;return{pose:{position:r,right:c,down:O(l,c),forward:l},lens:{fx:u,fy:d,cx:f,cy:p,width:m,height:h},target:o}}function rt(e){let t=new URLSearchParams(e.replace(/^#/,``)),[n,r]=[Qe(t.get(`p`),3),Qe(t.get(`r`),6)],[i,a]=[r?.slice(0,3),r?.slice(3)],[o,s]=[Qe(t.get(`t`),3),Qe(t.get(`l`),6)],c=nt({position:n,right:i,forward:a,target:o,lens:s}),l=t.get(`show`)??`color`,u=l in Ge?l:`color`;return c&&{...c,show:u,residuals:t.get(`texture`)!==`off`}}var it=()=>({views:[],notes:[],measures:[],unit:null,crop:{},hidden:[]}),at=1e3,ot=`bitymi-notes`,st=2,ct=1e9,lt=.001,ut=/[\u0000-\u0009\u000b-\u001f\u007f-\u009f]|\p{Cs}/gu,dt=`the whole`,I=(e,t)=>{throw Error(`${e}: ${t}`)};function L(e,t,n,r=[]){if(typeof e!=`object`||!e||Array.isArray(e))return I(t,`must be an object`);let i=n.find(t=>!(t in e));if(i)return I(t,`must have ${i}`);let a=Object.keys(e).find(e=>!n.includes(e)&&!r.includes(e));return a?I(t===dt?a:`${t}.${a}`,`is no such entry`):e}function R(e,t,n){return!Array.isArray(e)||e.length>n?I(t,`must be a list of at most ${n}`):e}function z(e,t,n,r=1){let i=typeof e==`string`?[...e].length:-1;return typeof e!=`string`||i<r||i>n||e!==V(e)?I(t,`must be text of ${r} to ${n} characters without control characters`):e}function ft(e,t,n=-1e9){return typeof e==`number`&&e>=n&&e<=ct?e:I(t,`must be a number from ${n} to ${ct}`)}var pt=[``,``,`two`,`three`,`four`];function mt(e,t,n=3){return Array.isArray(e)&&e.length===n&&e.every(e=>typeof e==`number`&&Math.abs(e)<=ct)?e:I(t,`must be ${pt[n]} numbers`)}var B=(e,t)=>mt(e,t);function ht(e,t,n){let r=mt(e,t,n);return Math.abs(Math.hypot(...r)-1)<=lt||I(t,`must have the length 1`),r}function gt(e,t){let{center:n,half:r,quat:i}=L(e,t,[`center`,`half`,`quat`]),a=B(r,`${t}.half`);Math.min(...a)<=0&&I(`${t}.half`,`must be positive`);let o=ht(i,`${t}.quat`,4);return{center:B(n,`${t}.center`),half:a,quat:o}}function _t(e){let{box:t,floor:n}=L(e,`crop`,[],[`box`,`floor`]),r={};if(t!==void 0&&(r.box=gt(t,`crop.box`)),n!==void 0){let{normal:e,offset:t}=L(n,`crop.floor`,[`normal`,`offset`]);r.floor={normal:ht(e,`crop.floor.normal`,3),offset:ft(t,`crop.floor.offset`)}}return r}function vt(e){let{name:t,per_world:n}=L(e,`unit`,[`name`,`per_world`]);return{name:z(t,`unit.name`,12),perWorld:ft(n,`unit.per_world`,1e-9)}}function yt(e,t){let{points:n,text:r}=L(e,t,[`points`],[`text`]),i=R(n,`${t}.points`,2);i.length<2&&I(`${t}.points`,`must be two points`);let[a,o]=i.map((e,n)=>B(e,`${t}.points.${n}`));return{points:[a,o],text:r===void 0?``:z(r,`${t}.text`,80,0)}}var V=e=>e.replace(ut,``);function bt(e){let t=JSON.parse(e),{version:n}=t??{};Number.isInteger(n)&&n>st&&I(`version`,`${String(n)} is newer than ${st}, which this page reads: export the page again`);let r=L(t,dt,[`format`,`version`,`views`,`notes`],n===1?[]:[`measures`,`unit`,`crop`,`hidden`]);r.format!==ot&&I(`format`,`must be ${ot}`),n!==1&&n!==2&&I(`version`,`must be 1 or ${st}`);let i=new Set,a=R(r.views,`views`,200).map((e,t)=>{let n=`views.${t}`,{name:r,...a}=L(e,n,[`name`,`position`,`right`,`forward`,`target`,`lens`]),o=z(r,`${n}.name`,80);return i.has(o)&&I(`${n}.name`,`is there twice`),i.add(o),{name:o,viewpoint:nt(a)??I(n,`must be a camera`)}}),o=R(r.notes,`notes`,500).map((e,t)=>{let{text:n,position:r}=L(e,`notes.${t}`,[`text`,`position`]),i=B(r,`notes.${t}.position`);return{text:z(n,`notes.${t}.text`,at),position:i}}),{measures:s=[],unit:c,crop:l,hidden:u=[]}=r;return{views:a,notes:o,measures:R(s,`measures`,500).map((e,t)=>yt(e,`measures.${t}`)),unit:c===void 0?null:vt(c),crop:l===void 0?{}:_t(l),hidden:R(u,`hidden`,200).map((e,t)=>gt(e,`hidden.${t}`))}}function xt(e){let{views:t,notes:n,measures:r,unit:i,crop:a,hidden:o}=e,s=t.map(({name:e,viewpoint:t})=>({name:e,...et(t)})),c={format:ot,version:r.length>0||i!==null||F(e)?2:1,views:s,notes:n};if(r.length){let e=r.map(({points:e,text:t})=>t?{points:e,text:t}:{points:e});Object.assign(c,{measures:e})}return i&&Object.assign(c,{unit:{name:i.name,per_world:i.perWorld}}),(a.box??a.floor)&&Object.assign(c,{crop:a}),o.length&&Object.assign(c,{hidden:o}),JSON.stringify(c,null,1)}var St=.001;function Ct({position:e,right:t,down:n,forward:r},i){let a=T(i,e);return[D(a,t),D(a,n),D(a,r)]}var H=class e{pose;fx;fy;cx;cy;width;height;constructor(e,t,n,r,i,a,o){this.pose=e,this.fx=t,this.fy=n,this.cx=r,this.cy=i,this.width=a,this.height=o}scaledTo(t,n){let[r,i]=[t/this.width,n/this.height];return new e(this.pose,this.fx*r,this.fy*i,this.cx*r,this.cy*i,t,n)}from(t){let n={...this.pose,position:T(this.pose.position,t)};return new e(n,this.fx,this.fy,this.cx,this.cy,this.width,this.height)}part(t,n,r,i){return new e(this.pose,this.fx,this.fy,this.cx-t,this.cy-n,r-t,i-n)}project(e){let[t,n,r]=Ct(this.pose,e),i=this.fx*t/r+this.cx,a=this.fy*n/r+this.cy;return r>0&&i>=0&&i<this.width&&a>=0&&a<this.height?[i,a,r]:null}segment(e,t){let[n,r]=[e,t].map(e=>Ct(this.pose,e)),i=St*Math.max(Math.abs(n[2]),Math.abs(r[2]));if(Math.max(n[2],r[2])<i||!i)return null;let a=(e,t)=>{let[n,r,a]=w(e,E(e[2]<i?(i-e[2])/(t[2]-e[2]):0,T(t,e)));return[this.fx*n/a+this.cx,this.fy*r/a+this.cy]};return[...a(n,r),...a(r,n)]}static contain(t,n,r,i){let a=Math.min(r/n.width,i/n.height),o=r/2+a*(n.cx-n.width/2),s=i/2+a*(n.cy-n.height/2);return new e(t,a*n.fx,a*n.fy,o,s,r,i)}},wt={fx:1e3,fy:1e3,cx:500,cy:500,width:1e3,height:1e3};function Tt(e,t,n){let r=A(T(t,e)),i=O(r,n),a=A(k(i)>1e-6?i:O(r,[n[1],n[2],n[0]]));return{position:e,right:a,down:O(r,a),forward:r}}function U(e,t,n){return{position:e.position,right:De(e.right,t,n),down:De(e.down,t,n),forward:De(e.forward,t,n)}}var Et=.998;function Dt(e,t,n){let r=U(e,e.right,n),[i,a]=[Math.abs(D(e.forward,t)),Math.abs(D(r.forward,t))];return(a<Et||a<i)&&D(e.down,t)*D(r.down,t)>0}function Ot(e,t,n,r){let i=U(e,t,-n);return Dt(i,t,r)?U(i,i.right,r):i}function kt(e,t,n,r,i){let a=Ct({...e,position:t},e.position);return W({...Ot(e,n,r,i),position:t},...a)}function W(e,t,n,r){let i=w(w(E(t,e.right),E(n,e.down)),E(r,e.forward));return{...e,position:w(e.position,i)}}function At(e,t){return U(e,e.forward,t)}var jt=e=>(e/1e6).toFixed(1);function Mt(e,t){G()||(p(`page-progress`).value=t?e/t:0,p(`page-text`).textContent=`${jt(e)} of ${jt(t)} MB`)}var G=()=>[`error`,`picture`].includes(document.documentElement.dataset.state??``),Nt=()=>void 0,Pt=e=>void(Nt=e);function K(e){if(G())return;let{title:t,message:n,advice:r}=i(e);p(`page-title`).textContent=t,p(`page-text`).textContent=n,p(`page-advice`).textContent=r,p(`page-progress`).hidden=!0;for(let e of[`top`,`panel`,`menu`,`aside`,`notes-panel`,`measure-panel`,`crop-panel`,`markers`])p(e).hidden=!0;p(`page`).hidden=!1,Bt(),document.documentElement.dataset.state=`error`,Nt(t,n)}function Ft(){if(!G()){p(`page`).hidden=!0;for(let e of[`top`,`panel`,`menu`])p(e).hidden=!1;document.documentElement.dataset.state=`ready`}}function q(e){let t=p(`notice`);t.textContent=e,t.hidden=!1,setTimeout(()=>t.hidden=!0,8e3)}async function It(e,t=()=>!1){let n=p(`poster`),r=n.src=URL.createObjectURL(e),i=await n.decode().then(()=>!0,()=>!1);return URL.revokeObjectURL(r),!i||t()?!1:(n.hidden=!1,!0)}async function Lt(e,t,n){for(let r of t)if(r&&await It(r,G)){document.title=p(`poster`).alt=n,p(`page-title`).textContent=`No WebGPU here: this is a picture`,p(`page-text`).hidden=p(`page-progress`).hidden=!0,document.documentElement.dataset.state=`picture`,Nt(e.title,e.message);return}K(e)}var Rt=!1;async function zt(e){e&&!Rt&&await It(e,()=>Rt)&&document.documentElement.dataset.state===`loading`&&(document.documentElement.dataset.state=`poster`)}function Bt(){Rt=!0,p(`poster`).hidden=!0}function Vt(e,t,n){return e.length>=t&&q(`There are ${t} ${n}, as many as there can be.`),e.length>=t}function Ht(e,t,n){let r=t.project(n);return e.hidden=!r,r&&Object.assign(e.style,{left:`${100*r[0]/t.width}%`,top:`${100*r[1]/t.height}%`}),r}var Ut=5,Wt=15,Gt=class{stage;canvas;pressedAt=null;wanted=null;constructor(e,t){this.stage=e,this.canvas=t,t.addEventListener(`pointerdown`,({isPrimary:e,button:t,clientX:n,clientY:r})=>{this.pressedAt=e&&t===0?[n,r]:null}),t.addEventListener(`pointerup`,({clientX:e,clientY:t,pointerType:n})=>{let{wanted:r,pressedAt:i}=this;this.pressedAt=null,r&&i&&(Math.hypot(e-i[0],t-i[1])>=(n===`touch`?Wt:Ut)||this.surface(e,t).then(e=>{r===this.wanted&&(e?(this.stop(),r.run(e)):q(`There is no surface at that pixel: click another.`))}))})}get waits(){return this.wanted!==null}start(e,t){this.stop(),this.wanted={button:e,run:t},m(p(e),!0),this.canvas.classList.add(`placing`)}stop(){this.wanted&&m(p(this.wanted.button),!1),this.wanted=null,this.canvas.classList.remove(`placing`)}toggle(e,t){h(p(e))?this.stop():this.start(e,t)}async surface(e,t){let[n,r]=[this.stage.view(),this.canvas.getBoundingClientRect()],i=(e-r.left)/r.width*n.width,a=(t-r.top)/r.height*n.height,o=new H(n.pose,n.fx,n.fy,n.cx-i+.5,n.cy-a+.5,1,1),[s]=(await this.stage.depths(o)).depth;if(!Number.isFinite(s))return null;let[c,l]=[(i-n.cx)/n.fx*s,(a-n.cy)/n.fy*s];return W(n.pose,c,l,s).position}},Kt=`http://www.w3.org/2000/svg`,qt=class{path=document.createElementNS(Kt,`path`);constructor(e){this.path.setAttribute(`class`,e),p(`lines`).append(this.path)}draw(e,t){let n=t.map(([t,n])=>e.segment(t,n)).filter(e=>e!==null);this.path.setAttribute(`d`,n.map(([e,t,n,r])=>`M${e} ${t}L${n} ${r}`).join(``)),this.path.ownerSVGElement?.setAttribute(`viewBox`,`0 0 ${e.width} ${e.height}`)}};function Jt({center:e,half:t,quat:n}){let r=P(n).map((e,n)=>E(t[n],e)),i=t=>r.reduce((e,n,r)=>w(e,E(t&1<<r?1:-1,n)),e),a=e=>[0,1,2,3,4,5,6,7].filter(t=>!(t&1<<e));return[0,1,2].flatMap(e=>a(e).map(t=>[i(t),i(t|1<<e)]))}var Yt=class{all;saved=!0;buttons=document.querySelectorAll(`.save-notes`);constructor(e){this.all=e;for(let t of this.buttons)t.onclick=()=>{te(`notes.json`,new Blob([xt(e)],{type:`application/json`})),this.saved=!0,this.show()};addEventListener(`beforeunload`,e=>{this.saved||e.preventDefault()}),this.show()}changed(){this.saved=!1,this.show()}show(){let{views:e,notes:t,measures:n,unit:r,crop:i,hidden:a}=this.all,o=![...e,...t,...n,...a].length&&!r&&!i.box&&!i.floor;for(let e of this.buttons)e.disabled=o&&this.saved,e.classList.toggle(`unsaved`,!this.saved)}},Xt=[`box`,`floor`,`hide`],Zt=[`Across`,`Along`,`Upwards`],Qt=400,$t=2,en=.05,tn=.01,nn=1e-4,rn=class{stage;picker;file;surfels;extent;mode=null;selected=null;anchor;turned=0;before;undone=[];lines=new qt(`box`);waiting=!1;constructor(e,t,n,r,i){this.stage=e,this.picker=t,this.file=n,this.surfels=r,this.extent=i,this.anchor=i.middle,this.before=this.copy();for(let e of Xt)v(`crop-${e}`,()=>this.choose(this.mode===e?null:e));v(`hide-selected`,()=>this.hideSelected()),v(`remove-crop`,()=>this.remove()),v(`undo`,()=>this.undo()),v(`reset-crop`,()=>{Object.assign(this.all,{crop:{},hidden:[]}),this.changed()}),v(`apply-crop`,()=>{g(`apply-crop`),this.apply()}),addEventListener(`keydown`,e=>{e.key!==`z`||!(e.ctrlKey||e.metaKey)||p(`crop-panel`).hidden||ee(e.target)||(e.preventDefault(),this.undo())}),this.makeSliders(),this.show(),F(this.all)&&this.apply()}drawn(e){let t=p(`crop-panel`).hidden?null:this.box;this.lines.draw(e,t?Jt(t):[])}get all(){return this.file.all}copy(){return structuredClone({crop:this.all.crop,hidden:this.all.hidden})}get box(){return this.mode===`box`?this.all.crop.box??null:this.mode===`hide`?this.selected:null}get reach(){return this.extent.size*(this.mode===`hide`?10*en:$t)}boxAt(e,t){return{center:e,half:[t,t,t],quat:Ae(this.extent.up)}}choose(e){let{middle:t,size:n,up:r}=this.extent;this.picker.stop(),this.mode=e,this.selected=null,this.anchor=t,e===`box`&&!this.all.crop.box?(this.all.crop.box=this.boxAt(t,n),this.changed()):e===`floor`?this.wait(e=>{this.all.crop.floor={normal:r,offset:D(r,e)-tn*n},this.changed()}):e===`hide`&&this.wait(e=>{this.anchor=e,this.selected=this.boxAt(e,en*n),this.show()}),this.show()}wait(e){this.picker.start(`crop-${this.mode}`,t=>{e(t),this.wait(e)})}hideSelected(){this.selected&&!Vt(this.all.hidden,200,`hidden boxes`)&&(this.all.hidden.push(this.selected),this.changed(),this.choose(`hide`))}remove(){this.mode===`floor`?delete this.all.crop.floor:delete this.all.crop.box,this.mode=null,this.picker.stop(),this.changed()}undo(){let e=this.undone.pop();e&&(Object.assign(this.all,e),this.settle())}changed(){this.undone.push(this.before),this.settle()}settle(){this.before=this.copy(),this.file.changed(),this.show(),this.apply()}apply(){let e=h(p(`apply-crop`))&&F(this.all);this.stage.hide(e?Ne(this.surfels,this.all):null)}applySoon(){this.waiting||(this.waiting=!0,requestAnimationFrame(()=>{this.waiting=!1,this.mode!==`hide`&&this.apply(),this.drawn(this.stage.view())}))}makeSliders(){let e=(e,t)=>{let n=_(`input`,{type:`range`,min:`-1`,max:`1`,step:`${2/Qt}`,ariaLabel:e});return n.oninput=()=>{t(n.valueAsNumber),this.applySoon()},n.onchange=()=>{this.mode!==`hide`&&this.changed()},n},t=Zt.map((t,n)=>_(`div`,{className:`slider`},_(`span`,{textContent:t}),e(`${t}, from`,e=>this.moveFace(n,0,e)),e(`${t}, to`,e=>this.moveFace(n,1,e)))),n=e(`Turn, degrees`,e=>this.turn(e));Object.assign(n,{id:`turn`,min:`-90`,max:`90`,step:`0.5`}),t.push(_(`div`,{className:`slider`},_(`span`,{textContent:`Turn`}),n)),p(`faces`).append(...t);let r=e(`Height of the floor`,e=>this.moveFloor(e));r.id=`height`,p(`floor-row`).append(r)}facesOf({center:e,half:t,quat:n}){let r=T(e,this.anchor);return P(n).map((e,n)=>[D(e,r)-t[n],D(e,r)+t[n]])}moveFace(e,t,n){let{box:r}=this;if(!r)return;let[i,a]=this.facesOf(r)[e],o=2*nn*this.extent.size,s=n*this.reach,[c,l]=t?[i,Math.max(s,i+o)]:[Math.min(s,a-o),a];r.center=w(r.center,E((c+l-i-a)/2,P(r.quat)[e])),r.half[e]=(l-c)/2}turn(e){if(!this.box)return;let t=(e-this.turned)*Math.PI/180,n=j(this.box.quat,M([0,0,t/2]));this.box.quat=n.map(e=>e/Math.hypot(...n)),this.turned=e}moveFloor(e){let{floor:t}=this.all.crop;t&&(t.offset=D(t.normal,this.extent.middle)+e*this.reach)}show(){let{crop:e,hidden:t}=this.all;this.mode===`box`&&!e.box&&(this.mode=null);for(let e of Xt)m(p(`crop-${e}`),this.mode===e);p(`faces`).hidden=!this.box,p(`floor-row`).hidden=this.mode!==`floor`||!e.floor,p(`hide-selected`).hidden=!this.selected,p(`remove-crop`).hidden=!(this.mode===`box`&&e.box)&&!(this.mode===`floor`&&e.floor),p(`crop-hint`).textContent={box:`Surfels outside of the box are hidden.`,floor:e.floor?`Surfels below are hidden. Click the ground, or move the slider.`:`Click the ground.`,hide:this.selected?`Fit the box around it.`:`Click a floater.`,none:`Hidden surfels stay in the bundle.`}[this.mode??`none`],this.turned=0,p(`turn`).valueAsNumber=0;let n=[...document.querySelectorAll(`#faces input`)];if(this.box&&this.facesOf(this.box).flat().forEach((e,t)=>n[t].valueAsNumber=e/this.reach),e.floor){let t=e.floor.offset-D(e.floor.normal,this.extent.middle);p(`height`).valueAsNumber=t/this.reach}let r=t.map((e,n)=>{let r=()=>{t.splice(t.indexOf(e),1),this.changed()},i=`Hidden box ${n+1}`;return _(`li`,{},_(`span`,{className:`name`,textContent:i}),y(`×`,{title:`Show ${i}`,run:r}))});p(`hidden-rows`).replaceChildren(...r),p(`undo`).disabled=!this.undone.length,p(`reset-crop`).disabled=!F(this.all),p(`apply-crop`).hidden=!F(this.all),this.drawn(this.stage.view())}},an={name:`units`,perWorld:1},on=4,sn=`This device measures depths to three digits.`,cn=({points:[e,t]})=>k(T(e,t));function ln(e,{name:t,perWorld:n}){return`${Number((e*n).toPrecision(on)).toLocaleString(`en`,{maximumSignificantDigits:on,useGrouping:!1})} ${t}`}var un=class{stage;picker;file;metres;first=null;chosen=null;labels=new Map;lines=new qt(`measures`);ends=new qt(`ends`);constructor(e,t,n,r){this.stage=e,this.picker=t,this.file=n,this.metres=r,v(`add-measure`,()=>this.toggle()),v(`set-unit`,()=>this.setUnit()),p(`known-row`).addEventListener(`keydown`,e=>{e.key===`Enter`&&ee(e.target)&&this.setUnit()}),v(`reset-unit`,()=>{this.file.all.unit=null,this.changed()}),this.chosen=n.all.measures.at(-1)??null,this.show()}drawn(e){let{measures:t}=this.file.all,n=t.flatMap(({points:e})=>e),r=h(p(`add-measure`));this.first&&r&&n.push(this.first);let i=r?[`Click the ${this.first?`other`:`first`} surface.`]:[];p(`measure-hint`).textContent=[...i,...this.stage.coarse?[sn]:[]].join(` `);let[a,o]=[t.map(({points:e})=>e),n.map(e=>[e,e])];this.lines.draw(e,a),this.ends.draw(e,o);for(let[{points:t},n]of this.labels)Ht(n,e,E(.5,w(...t)))}get unit(){return this.file.all.unit??(this.metres?{name:`m`,perWorld:this.metres}:an)}toggle(){this.first=null,Vt(this.file.all.measures,500,`measures`)||(this.picker.toggle(`add-measure`,e=>{this.first=e,this.picker.start(`add-measure`,t=>{this.first=null,k(T(e,t))?(this.chosen={points:[e,t],text:``},this.file.all.measures.push(this.chosen),this.changed()):this.redraw()}),this.redraw()}),this.redraw())}setUnit(){let e=p(`known`).valueAsNumber,t=V(p(`unit-name`).value).trim()||`m`;if(!this.chosen||!(e>0)){q(`Choose a measure, and enter its length.`);return}let n=e/cn(this.chosen);n>=1e-9&&n<=1e9?(this.file.all.unit={name:[...t].slice(0,12).join(``),perWorld:n},p(`known`).value=``,this.changed()):q(`That length is not possible.`)}changed(){this.file.changed(),this.show()}redraw(){this.drawn(this.stage.view())}show(){let{measures:e,unit:t}=this.file.all;p(`measure-rows`).replaceChildren(...e.map(e=>this.row(e))),p(`known-row`).hidden=!e.length,p(`reset-unit`).hidden=!t,p(`unit-name`).value=this.unit===an?`m`:this.unit.name;for(let e of this.labels.values())e.remove();this.labels.clear();for(let t of e){let e=_(`div`,{className:`label`},_(`span`,{textContent:[t.text,ln(cn(t),this.unit)].filter(Boolean).join(`: `)}));this.labels.set(t,e)}p(`labels`).replaceChildren(...this.labels.values()),this.redraw()}row(e){let{measures:t}=this.file.all,n=ln(cn(e),this.unit),r=_(`input`,{type:`text`,className:`name`,value:e.text,maxLength:80});Object.assign(r,{placeholder:`Label`,ariaLabel:`Label of the measure of ${n}`}),r.onchange=()=>{e.text=V(r.value).trim(),this.changed()};let i=y(n,{title:`Choose it, to state its length`,run:()=>{this.chosen=e,this.show(),p(`known`).focus()}});return i.setAttribute(`aria-pressed`,String(e===this.chosen)),_(`li`,{},r,i,y(`×`,{ariaLabel:`Remove ${n}`,title:`Remove`,run:()=>{t.splice(t.indexOf(e),1),e===this.chosen&&(this.chosen=t.at(-1)??null),this.changed()}}))}},dn=.97,fn=class{stage;picker;file;editing=null;markers=new Map;constructor(e,t,n){this.stage=e,this.picker=t,this.file=n,v(`save-view`,()=>this.addView()),p(`view-name`).addEventListener(`keydown`,({key:e})=>{e===`Enter`&&this.addView()}),v(`add-note`,()=>this.add()),v(`show-notes`,()=>{p(`markers`).hidden=!g(`show-notes`)}),this.show()}get all(){return this.file.all}get names(){return this.all.views.map(({name:e})=>e)}goTo(e){let t=this.all.views.find(t=>t.name===e);return t&&this.stage.fly(t.viewpoint),t!==void 0}async drawn(e,t){let n=[];for(let[{position:r},i]of this.markers){let a=Ht(i,e,r);if(!a)continue;let[o,s,c]=[a[0]/e.width,a[1]/e.height,a[2]];i.classList.toggle(`left`,o>.55),t||i.classList.remove(`behind`),n.push({marker:i,x:o,y:s,z:c})}if(!t||!n.length||p(`markers`).hidden)return;let r=await this.stage.depths(e.scaledTo(Math.ceil(e.width/4),Math.ceil(e.height/4)));for(let{marker:e,x:t,y:i,z:a}of n){let n=r.depth[Math.floor(i*r.height)*r.width+Math.floor(t*r.width)];e.classList.toggle(`behind`,n<dn*a)}}changed(){this.file.changed(),this.show()}addView(){let{views:e}=this.all,t=p(`view-name`),n=e.length+1;for(;this.names.includes(`View ${n}`);)n++;let r=V(t.value).trim()||`View ${n}`,{pose:i,lens:a,target:o}=this.stage.shared(),s=e.find(e=>e.name===r);s?s.viewpoint={pose:i,lens:a,target:o}:Vt(e,200,`views`)||e.push({name:r,viewpoint:{pose:i,lens:a,target:o}}),t.value=``,this.changed()}add(){Vt(this.all.notes,500,`notes`)||this.picker.toggle(`add-note`,e=>{this.editing={text:``,position:e},this.all.notes.push(this.editing),this.show()})}goToNote({position:e}){let{pose:t,lens:n,target:r}=this.stage.shared(),i=k(T(r,t.position));this.stage.fly({pose:W({...t,position:e},0,0,-i),lens:n,target:e})}show(){let{views:e,notes:t}=this.all,n=e.map(t=>this.row(e,t,t.name,()=>this.stage.fly(t.viewpoint))),r=t.map(e=>this.row(t,e,e.text,()=>this.goToNote(e)));p(`view-rows`).replaceChildren(...n),p(`note-rows`).replaceChildren(...r),this.markers.clear();for(let e of t)this.markers.set(e,_(`div`,{className:`marker`},_(`span`,{textContent:e.text})));p(`note-markers`).replaceChildren(...this.markers.values()),this.drawn(this.stage.view(),!0),document.querySelector(`#notes-panel li :is(input, textarea)`)?.focus()}row(e,t,n,r){return this.editing===t?_(`li`,{},this.field(e,t,n)):_(`li`,{},y(n,{className:`name`,title:`Go to ${n}`,run:r}),y(`✎`,{ariaLabel:`Edit ${n}`,title:`Edit`,run:()=>{this.editing=t,this.show()}}),y(`×`,{ariaLabel:`Remove ${n}`,title:`Remove`,run:()=>{e.splice(e.indexOf(t),1),this.changed()}}))}field(e,t,n){let r=`text`in t,i={value:n,maxLength:r?at:80,className:`name`},a=r?_(`textarea`,{...i,rows:3,ariaLabel:`Text of the note`}):_(`input`,{...i,type:`text`,ariaLabel:`Name of the view`}),o=i=>{if(this.editing!==t)return;this.editing=null;let a=!r&&i!==n&&this.names.includes(i);a&&q(`Another view has the name ${i}.`);let o=a?n:i||n;r?t.text=o:t.name=o,o||e.splice(e.indexOf(t),1),o===n?this.show():this.changed()};return a.onblur=()=>o(V(a.value).trim()),a.onkeydown=e=>{e.key===`Escape`?o(n):e.key===`Enter`&&!e.shiftKey&&a.blur()},a}},pn=[[`tools`,`close`,`aside`],[`notes`,`close-notes`,`notes-panel`],[`measure`,`close-measure`,`measure-panel`],[`crop`,`close-crop`,`crop-panel`]],mn=()=>matchMedia(`(width <= 720px)`).matches,hn=()=>p(`panel`).classList.contains(`open`);function gn(e,t){let n=e===`panel`?t:hn()&&!(t&&mn());p(`panel`).classList.toggle(`open`,n),p(`menu`).setAttribute(`aria-expanded`,String(n));for(let[n,,r]of pn){let i=!p(r).hidden&&(!t||e===`panel`&&!mn());p(r).hidden=e===r?!t:!i,m(p(n),!p(r).hidden)}}function _n(){let e=document.documentElement,t={"":`light`,light:`dark`,dark:``}[e.dataset.theme??``]??``;t?e.dataset.theme=t:delete e.dataset.theme,p(`theme`).textContent=t?`Theme: ${t}`:`Theme`}function vn(e,t){gn(`panel`,!mn());for(let e of[`menu`,`hide-panel`])v(e,()=>gn(`panel`,!hn()));for(let[n,r,i]of pn)v(n,()=>{gn(i,p(i).hidden),t()}),v(r,()=>{gn(i,!1),e.focus(),t()});v(`theme`,_n);let n=p(`help`);v(`show-help`,()=>n.open?n.close():n.showModal()),v(`close-help`,()=>n.close()),n.addEventListener(`click`,({target:e})=>{e===n&&n.close()}),p(`full-screen`).hidden=!document.fullscreenEnabled,v(`full-screen`,()=>{document.fullscreenElement?document.exitFullscreen():document.documentElement.requestFullscreen()}),document.addEventListener(`fullscreenchange`,()=>{m(p(`full-screen`),document.fullscreenElement!==null)})}var yn=.1,bn=36e3,xn=1e3,Sn=.8,Cn=3,wn=class{keyframes=[];smooth=!0;loop=!1;get segments(){return this.keyframes.length<2?0:this.keyframes.length-+!this.loop}get seconds(){return this.keyframes.slice(0,this.segments).reduce((e,{seconds:t})=>e+t,0)}set seconds(e){let t=e/this.seconds;for(let e of this.keyframes)e.seconds=Dn(t*e.seconds)}at(e,t,n){let[r,i]=[0,Math.min(Math.max(e,0),this.seconds)];for(;r+1<this.segments&&i>=this.keyframes[r].seconds;)i-=this.keyframes[r++].seconds;let a=this.keyframes.length,[o,s]=[this.keyframes[r],this.keyframes[(r+1)%a]],c=o.seconds,l=i/c,u=({pose:e,lens:r})=>H.contain(e,r,t,n),d=e=>[Math.log(u(e).fx),Math.log(u(e).fy),0],f=e=>[u(e).cx,u(e).cy,0],p=({pose:e})=>e.position,m=e=>{let t=this.speeds(r,(t,n)=>T(e(n),e(t)));return jn(e(o),e(s),E(c,t[0]),E(c,t[1]),l)},h=this.speeds(r,(e,t)=>Oe(N(e.pose),N(t.pose))),g=Mn(N(o.pose),N(s.pose),E(c,h[0]),E(c,h[1]),l),[_,v]=m(d).map(Math.exp),[y,b]=m(f);return new H(je(m(p),g),_,v,y,b,t,n)}speeds(e,t){let n=this.keyframes.length,r=e=>{let r=this.loop?(e+n)%n:e;return r<0||r>=this.segments?null:E(1/this.keyframes[r].seconds,t(this.keyframes[r],this.keyframes[(r+1)%n]))},i=r(e),a=e=>{let[t,a]=[r(e-1),r(e)];if(!this.smooth||!t||!a)return i;let[o,s]=[this.keyframes[(e-1+n)%n].seconds,this.keyframes[e%n].seconds],c=E(1/(o+s),w(E(s,t),E(o,a))),l=Cn*Math.min(k(t),k(a));return E(Math.min(1,l/Math.max(k(c),1e-12)),c)};return[a(e),a(e+1)]}file(e,t){let{seconds:n}=this,r=e/t,i=Math.min(bn,Math.max(2,Math.round(30*n))),a=n/(this.loop?i:i-1),o=Array.from({length:i},(n,i)=>{let{pose:o,fy:s,cx:c,cy:l}=this.at(i*a,e,t),u=[c/e,l/t];return{camera_to_world:An(o),fov:En(s,t),aspect:r,principal_point:u}}),s=this.keyframes.map(({pose:n,lens:i},a)=>({matrix:An(n),fov:En(H.contain(n,i,e,t).fy,t),aspect:r,override_transition_enabled:!0,override_transition_sec:this.keyframes.at(a-1).seconds,lens:Xe(i)}));return JSON.stringify({keyframes:s,camera_type:`perspective`,render_height:t,render_width:e,camera_path:o,fps:i/n,seconds:n,smoothness_value:+!this.smooth,is_cycle:this.loop,crop:null})}load(e){let t=JSON.parse(e),n=t?.keyframes;if(!Array.isArray(n)||!n.length||n.length>xn)throw Error(`it has not 1 to ${xn} keyframes.`);if((t?.camera_type??`perspective`)!==`perspective`)throw Error(`its cameras are not perspective.`);let r=On(t?.default_transition_sec)??2,i=n.map((e,t)=>kn(e??{},t,r));this.keyframes=i.map((e,t)=>({...e,seconds:i[(t+1)%i.length].seconds})),this.smooth=t?.smoothness_value!==1,this.loop=t?.is_cycle===!0}},Tn=class{to;path=new wn;since=null;constructor(e,t){this.to=t,this.path.keyframes=[e,t].map(({pose:e,lens:t})=>({pose:e,lens:t,seconds:Sn}))}at(e,t,n){this.since??=e;let r=(e-this.since)/(1e3*Sn);return r<1?this.path.at(Sn*r*r*(3-2*r),t,n):null}},En=(e,t)=>360/Math.PI*Math.atan(t/2/e),Dn=e=>Math.min(600,Math.max(yn,e)),On=e=>typeof e==`number`&&e>0?Dn(e):null;function kn(e,t,n){let{matrix:r,fov:i,aspect:a,override_transition_enabled:o,override_transition_sec:s}=e,c=Array.isArray(r)&&r.length===16?r:[],[l,u,d,f]=[0,1,2,3].map(e=>[c[e],c[e+4],c[e+8]]),{lens:p}=e;if(p===void 0){let[e,t]=[1e3*Number(a),1e3],n=t/2/Math.tan(Math.PI/360*Number(i));p=[n,n,e/2,t/2,e,t]}let m=nt({position:f,right:l,forward:E(-1,d),target:f,lens:p});if(!m||!(D(m.pose.down,u)<-.9))throw Error(`keyframe ${t+1} is no camera.`);return{...m,seconds:(o===!0?On(s):null)??n}}function An({position:e,right:t,down:n,forward:r}){return[...[0,1,2].flatMap(i=>[t[i],-n[i],-r[i],e[i]]),0,0,0,1]}function jn(e,t,n,r,i){let a=1-i;return w(w(E(a*a*(1+2*i),e),E(i*i*(1+2*a),t)),w(E(a*a*i,n),E(-a*i*i,r)))}function Mn(e,t,n,r,i){let a=[e,j(e,M(E(1/3,n))),j(t,M(E(-1/3,r))),t];for(;a.length>1;)a=a.slice(1).map((e,t)=>ke(a[t],e,i));return a[0]}var Nn=1<<26,Pn=`video/webm`,Fn=16e6,In=100,Ln=()=>typeof MediaRecorder<`u`&&`captureStream`in HTMLCanvasElement.prototype&&MediaRecorder.isTypeSupported(Pn),Rn=class{parts=[];recorder;constructor(e){this.recorder=new MediaRecorder(e.captureStream(),{mimeType:Pn,videoBitsPerSecond:Fn}),this.recorder.ondataavailable=({data:e})=>this.parts.push(e),this.recorder.start()}end(){return new Promise(e=>{this.recorder.onstop=()=>e(new Blob(this.parts,{type:Pn})),setTimeout(()=>{this.recorder.stop();for(let e of this.recorder.stream.getTracks())e.stop()},In)})}},zn=class{stage;canvas;path=new wn;playing=null;constructor(e,t){this.stage=e,this.canvas=t,v(`add-keyframe`,()=>this.add()),v(`smooth`,()=>this.toggle(`smooth`)),v(`loop`,()=>this.toggle(`loop`)),v(`play`,()=>this.playing?this.stop():this.play(!1)),v(`save-path`,()=>this.save()),v(`open-path`,()=>p(`path-file`).click()),p(`path-file`).addEventListener(`change`,({target:e})=>{let[t]=e.files??[];t&&this.open(t)}),v(`record`,()=>this.playing?this.stop():this.play(!0)),p(`seconds`).addEventListener(`change`,({target:e})=>{let{valueAsNumber:t}=e;t>0&&(this.path.seconds=t),this.show()}),p(`record`).hidden=!Ln(),this.show()}advance(e){let{playing:t,path:n}=this;if(!t||t.wanted)return t?.wanted??null;let r=(e-t.since)/1e3;if(r<n.seconds)return this.view(r);let i=this.view(n.seconds);return n.loop&&!t.record?t.since=e:t.wanted=i,i}drawn(e){let{playing:t}=this;t&&e===t.wanted?.pose&&(t.since?this.stop():(t.since=performance.now(),t.wanted=null,t.record&&(t.film=new Rn(this.canvas))))}stop(){if(!this.playing)return;let{film:e}=this.playing;this.playing=null,this.show(),e?.end().then(e=>te(this.stage.fileName(`webm`),e))}get plays(){return this.playing!==null}get filming(){return this.playing?.record===!0}view(e){return this.path.at(e,...this.stage.pixels())}play(e){this.stop(),this.playing={record:e,film:null,since:0,wanted:this.view(0)},this.show()}add(){let{pose:e,lens:t}=this.stage.shared();this.path.keyframes.push({pose:e,lens:t,seconds:2}),this.stop(),this.show()}toggle(e){this.path[e]=g(e),this.show()}save(){let e=p(`path-size`).value,[t,n]=e?e.split(`x`).map(Number):this.stage.pixels().map(e=>e-e%2),r=this.path.file(t,n);te(`camera_path.json`,new Blob([r],{type:`application/json`}))}async open(e){this.stop();try{if(e.size>Nn)throw Error(`it has ${e.size} bytes, at most ${Nn} are read.`);this.path.load(await e.text())}catch(t){q(`${e.name} is no camera path: ${r(t)}`)}p(`path-file`).value=``;for(let e of[`smooth`,`loop`])m(p(e),this.path[e]);this.show()}show(){let{keyframes:e,loop:t,seconds:n}=this.path;p(`keyframes`).replaceChildren(...e.map((n,r)=>{let i=()=>this.stage.go({pose:n.pose,lens:n.lens}),a=()=>{this.stop(),e.splice(r,1),this.show()},o=(r+1)%e.length,s=_(`li`,{},y(`Keyframe ${r+1}`,{className:`name`,title:`Go there`,run:i}));return e.length>1&&(o||t)&&s.append(Bn(r+1,o+1,n,()=>this.show())),s.append(y(`×`,{ariaLabel:`Remove keyframe ${r+1}`,title:`Remove`,run:a})),s})),p(`seconds`).value=n?String(Number(n.toFixed(2))):``;for(let t of[`seconds`,`play`,`save-path`,`record`,`smooth`,`loop`,`path-size`])p(t).disabled=e.length<2;p(`play`).textContent=this.playing&&!this.filming?`Stop`:`Play`,p(`record`).textContent=this.filming?`Stop`:`Record`}};function Bn(e,t,n,r){let i=`Seconds from keyframe ${e} to ${t}`,a=_(`input`,{type:`number`,min:`${yn}`,max:`600`,step:`any`,ariaLabel:i});return a.value=String(Number(n.seconds.toFixed(2))),a.onchange=()=>{let e=a.valueAsNumber;e>0&&(n.seconds=Dn(e)),r()},_(`label`,{className:`seconds`},a,` s`)}var Vn=/^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$/,Hn=1e5,Un=1e-6,Wn=e=>typeof e==`number`&&Number.isFinite(e);function Gn(e){return!Array.isArray(e)||!e.every(Wn)?null:e.length===3?e.flatMap((e,t)=>[0,1,2,3].map(n=>n===t?e:0)):e.length===12?e:null}function Kn(e){if(typeof e!=`object`||!e)return null;let t=e,[n,r,i,a,o,s,c]=[t.viewmat,t.fx,t.fy,t.cx,t.cy,t.width,t.height];if(!Array.isArray(n)||n.length!==16||!n.every(Wn)||![r,i,a,o,s,c].every(Wn)||typeof t.name!=`string`)return null;let l={fx:r,fy:i,cx:a,cy:o,width:s,height:c};if(!(l.fx>0&&l.fy>0&&l.width>=1&&l.height>=1))return null;let[u,d,f]=[0,4,8].map(e=>n.slice(e,e+3)),p=w(w(E(n[3],u),E(n[7],d)),E(n[11],f)),m=typeof t.photograph==`string`&&Vn.test(t.photograph)?t.photograph:null;return{name:t.name.slice(0,200),heldOut:t.held_out===!0,pose:{position:E(-1,p),right:u,down:d,forward:f},lens:l,photograph:m,correction:Gn(t.correction)}}function qn(e){let t;try{t=JSON.parse(e)}catch{return[]}let n=t?.cameras;return Array.isArray(n)?n.slice(0,Hn).map(Kn).filter(e=>e!==null):[]}function Jn(e,t){let n=(e,t)=>k(T(e,t))<Un*(1+k(t));return e.find(({pose:e})=>n(t.position,e.position)&&n(t.right,e.right)&&n(t.forward,e.forward))?.correction??null}function Yn(e){let t=[0,0,0,0,0,0,0,0,0],n=[0,0,0];for(let{pose:r}of e){let e=r.forward;for(let n=0;n<3;n++)for(let r=0;r<3;r++)t[3*n+r]+=+(n===r)-e[n]*e[r];n=w(n,T(r.position,E(D(e,r.position),e)))}let r=e=>[t[e],t[3+e],t[6+e]],i=(e,t,n)=>e[0]*(t[1]*n[2]-t[2]*n[1])+e[1]*(t[2]*n[0]-t[0]*n[2])+e[2]*(t[0]*n[1]-t[1]*n[0]),a=i(r(0),r(1),r(2));return Math.abs(a)>1e-4*e.length**3?[i(n,r(1),r(2))/a,i(r(0),n,r(2))/a,i(r(0),r(1),n)/a]:null}var Xn=4e3;function Zn(e){let t=Math.max(1,Math.floor(e.count/Xn)),n=[];for(let r=0;r<e.count;r+=t){let t=r*24;n.push([e.words[t],e.words[t+1],e.words[t+2]])}if(!n.length)return{middle:[0,0,0],size:1};let r=e=>e.sort((e,t)=>e-t)[e.length>>1],i=[0,1,2].map(e=>r(n.map(t=>t[e]))),a=r(n.map(e=>k([e[0]-i[0],e[1]-i[1],e[2]-i[2]])));return{middle:w(i,e.origin),size:Math.max(2*a,1e-6)}}function Qn(e,t,n){let r=Math.min(Math.max(1,.5*t),1.6*t),i=A(w(A(O(n,Math.abs(n[0])<.9?[1,0,0]:[0,1,0])),E(.3,n)));return Tt(w(e,E(r,k(e)>.5*r?A(E(-1,e)):i)),e,n)}var $n=50,er=class{surface;pose;target;up;size;changed;mode=`orbit`;pointers=new Map;held=new Set;last=0;constructor(e,t,n,r,i,a){this.surface=e,this.pose=t,this.target=n,this.up=r,this.size=i,this.changed=a,e.addEventListener(`pointerdown`,t=>{e.setPointerCapture(t.pointerId),this.pointers.set(t.pointerId,{x:t.clientX,y:t.clientY})});for(let t of[`pointerup`,`pointercancel`])e.addEventListener(t,e=>this.pointers.delete(e.pointerId));e.addEventListener(`pointermove`,e=>this.drag(e)),e.addEventListener(`contextmenu`,e=>e.preventDefault()),e.addEventListener(`wheel`,e=>{e.preventDefault(),this.approach(Math.exp(-e.deltaY*(e.deltaMode===1?.05:.0015)))},{passive:!1}),addEventListener(`keydown`,e=>{b(e.target)||e.ctrlKey||e.metaKey||e.altKey||!tr[e.code]||(e.preventDefault(),this.held.has(e.code)||(this.held.add(e.code),this.last=e.timeStamp-$n,this.advance(e.timeStamp)))}),addEventListener(`keyup`,e=>this.held.delete(e.code)),addEventListener(`blur`,()=>this.held.clear())}distance(){return Math.max(k(T(this.target,this.pose.position)),.001*this.size)}drag(e){let t=this.pointers.get(e.pointerId);if(!t)return;let[n,r]=[e.clientX-t.x,e.clientY-t.y],i=[...this.pointers].filter(([t])=>t!==e.pointerId).map(([,e])=>e);this.pointers.set(e.pointerId,{x:e.clientX,y:e.clientY});let a=Math.min(this.surface.clientWidth,this.surface.clientHeight);if(i.length===1){let o=e=>Math.hypot(e.x-i[0].x,e.y-i[0].y);this.slide(n/2/a,r/2/a),this.approach(o({x:e.clientX,y:e.clientY})/Math.max(o(t),1))}else e.buttons&6||e.shiftKey?this.slide(n/a,r/a):this.turn(n/a*3,r/a*3)}turn(e,t){this.mode===`orbit`?this.pose=kt(this.pose,this.target,this.up,e,-t):this.lookBy(-e/2,-t/2),this.changed()}lookBy(e,t){let n=this.distance();this.pose=Ot(this.pose,this.up,e,-t),this.target=W(this.pose,0,0,n).position}slide(e,t){let n=this.mode===`orbit`?this.distance():this.size;this.step(-e*n,-t*n,0)}approach(e){let t=this.distance();this.mode===`orbit`?this.pose=W(this.pose,0,0,t-t/e):this.step(0,0,Math.log(e)*.5*this.size),this.changed()}step(e,t,n){let r=this.pose.position;this.pose=W(this.pose,e,t,n),this.target=w(this.target,T(this.pose.position,r)),this.changed()}advance(e){let t=Math.min(.1,Math.max(0,e-this.last)/1e3);if(this.last=Math.max(e,this.last),!this.held.size)return!1;let n=this.held.has(`ShiftLeft`)||this.held.has(`ShiftRight`)?4:1;for(let e of this.held){let[r,i,a,o,s,c]=tr[e],l=.35*this.size*t*n;(r||i||a)&&this.step(r*l,i*l,a*l),(o||s)&&this.lookBy(o*t,-s*t),c&&(this.pose=At(this.pose,c*t))}return this.changed(),!0}},tr={KeyW:[0,0,1,0,0,0],KeyS:[0,0,-1,0,0,0],KeyA:[-1,0,0,0,0,0],KeyD:[1,0,0,0,0,0],KeyQ:[0,1,0,0,0,0],KeyE:[0,-1,0,0,0,0],ArrowLeft:[0,0,0,-1,0,0],ArrowRight:[0,0,0,1,0,0],ArrowUp:[0,0,0,0,1,0],ArrowDown:[0,0,0,0,-1,0],KeyZ:[0,0,0,0,0,-1],KeyX:[0,0,0,0,0,1],ShiftLeft:[0,0,0,0,0,0],ShiftRight:[0,0,0,0,0,0]},nr=4,rr=16,ir=250,ar={o:`orbit`,f:`fly`,h:`home`,",":`previous`,".":`next`,p:`beside`,t:`texture`,c:`colors`,i:`exposure`,l:`share`,n:`tools`,m:`notes`,k:`add-keyframe`,v:`play`,r:`measure`,b:`crop`,g:`full-screen`,u:`menu`,"?":`show-help`},or=()=>q(`This view cannot be saved: there is not enough memory for it.`),sr=class{canvas;screen;renderer;bundle;shown;controls;path;picker;notes;measures;crop;cameras;pace=new f;size;lens=wt;first;held=null;flight=null;show=`color`;photograph=null;dirty=!0;still=!1;movedAt=0;drawing=!1;constructor(e,t,n,r,i,a){this.canvas=e,this.screen=t,this.renderer=n,this.bundle=r,this.shown=a;let{info:o,surfels:s}=r,{middle:c,size:l}=Zn(s),u=o.up??[0,0,1];if(this.size=l,this.cameras=qn(r.cameras??``),this.first={pose:Qn(c,l,u),target:c,lens:wt},this.cameras.length){let e=this.cameras.find(e=>e.heldOut)??this.cameras[0];this.first={pose:e.pose,target:this.targetOf(e.pose),lens:e.lens}}this.controls=new er(e,this.first.pose,this.first.target,u,l,()=>{this.path.stop(),this.flight=null,this.changed()}),this.lens=this.first.lens,this.path=new zn(this,e),this.picker=new Gt(this,e);let d=new Yt(i);this.notes=new fn(this,this.picker,d),this.measures=new un(this,this.picker,d,o.metres),this.crop=new rn(this,this.picker,d,s,{middle:c,size:l,up:A(u)}),this.bind()}start(){this.applyHash(),new ResizeObserver(()=>this.changed()).observe(this.canvas),addEventListener(`hashchange`,()=>this.applyHash()),this.canvas.focus(),requestAnimationFrame(e=>this.tick(e))}applyHash(){let e=rt(location.hash);e&&this.apply(e)}targetOf(e){let t=Yn(this.cameras);return W(e,0,0,t?k(T(t,e.position)):this.size).position}shared(){let{pose:e,target:t}=this.controls;return{pose:e,target:t,lens:this.lens,show:this.show,residuals:h(p(`texture`))}}go({pose:e,lens:t,target:n}){this.path.stop(),this.flight=null,this.place(e,t,n)}fly(e){matchMedia(`(prefers-reduced-motion: reduce)`).matches?this.go(e):(this.path.stop(),this.flight=new Tn(this.shared(),e),this.changed())}view(){return H.contain(this.controls.pose,this.lens,...this.pixels())}hide(e){this.renderer.scene.hide(e),this.changed()}async turnAround(e,t){let n=this.picker.waits?null:await this.picker.surface(e,t);if(!n)return;let{pose:r}=this.controls,i=k(T(n,r.position));this.fly({pose:W({...r,position:n},0,0,-i),lens:this.lens,target:n})}get coarse(){return this.renderer.coarse}depths(e){return this.renderer.depths(e,this.options(e.width===1))}place(e,t,n=this.targetOf(e)){this.controls.pose=e,this.controls.target=n,this.lens=t,this.changed()}fileName(e){return`${document.title||`scene`}.${e}`}apply(e){this.setShow(e.show),m(p(`texture`),e.residuals),this.go(e)}changed(){this.dirty=!0,this.still=!1,this.movedAt=performance.now(),document.documentElement.dataset.frame=`moving`}options(e){return{show:this.show,residuals:h(p(`texture`)),held:this.held,background:this.bundle.info.background,correction:this.correction,layers:e?rr:nr,fine:e,farthest:k(T(this.controls.pose.position,this.first.target))+1.5*this.size}}get correction(){return this.show===`color`&&h(p(`exposure`))&&!this.path.plays?Jn(this.cameras,this.controls.pose):null}tick(e){if(G())return;requestAnimationFrame(e=>this.tick(e)),this.controls.advance(e);let t=this.path.advance(e);t?this.place(t.pose,t):this.flight&&this.flyOn(this.flight,e),this.drawing||(this.dirty?this.frame(!1):!this.still&&e-this.movedAt>ir&&this.frame(!0))}flyOn(e,t){let n=e.at(t,...this.pixels());n?this.place(n.pose,n):this.go(e.to)}pixels(){let{clientWidth:e,clientHeight:t}=this.canvas,n=this.renderer.largestSide/Math.max(e,t,1),r=Math.min(devicePixelRatio,2,n);return[Math.round(e*r),Math.round(t*r)]}async frame(e){this.drawing=!0,this.dirty=!1;let t=this.view();if(t.width>0&&t.height>0){let n=p(`resolution`).value,r=n===`auto`?e||this.path.filming?1:this.pace.scale:Number(n),i=performance.now();try{await this.screen(t,r,this.options(e))}catch(e){K(e);return}let a=performance.now()-i;Bt(),this.path.drawn(t.pose),this.notes.drawn(t,e),this.measures.drawn(t),this.crop.drawn(t),this.shown(),!e&&n===`auto`&&this.pace.took(a),this.still=e&&!this.dirty,this.report(a,r);let{complete:o}=this.renderer.scene;document.documentElement.dataset.frame=o?this.still?`still`:`moving`:`first`}this.drawing=!1}report(e,t){let{scene:n}=this.renderer,[r,i]=[n.shown,n.count].map(e=>e.toLocaleString(`en`)),a=r===i?i:`${r} of ${i}`,o=n.complete?``:` · the texture is on its way`;p(`status`).textContent=`${e.toFixed(+(e<10))} ms · ${Math.round(100*t)} % · ${a} surfels${o}`}bind(){v(`orbit`,()=>this.setMode(`orbit`)),v(`fly`,()=>this.setMode(`fly`)),v(`home`,()=>this.go(this.first)),v(`previous`,()=>this.jump(this.chosen-1)),v(`next`,()=>this.jump(this.chosen+1)),v(`beside`,()=>this.toggleBeside()),v(`texture`,()=>this.toggle(`texture`)),v(`exposure`,()=>this.toggle(`exposure`)),v(`colors`,()=>{this.held=this.toggle(`colors`)?null:this.controls.pose.position}),v(`screenshot`,()=>void this.screenshot().catch(or)),v(`share`,()=>void this.share()),vn(this.canvas,()=>this.endPicking()),this.canvas.addEventListener(`dblclick`,({clientX:e,clientY:t})=>void this.turnAround(e,t)),p(`resolution`).addEventListener(`change`,()=>this.changed());let e=p(`show`);e.addEventListener(`change`,()=>this.setShow(e.value)),p(`camera`).addEventListener(`change`,()=>this.jump(this.chosen)),addEventListener(`keydown`,e=>this.shortcut(e)),this.fillCameras()}endPicking(){this.picker.stop(),this.crop.choose(null),this.changed()}cancel(){this.picker.waits?this.endPicking():document.querySelector(`.aside:not([hidden]) .close`)?.click()}shortcut(e){if(ee(e.target)||((e.ctrlKey||e.metaKey)&&e.code===`KeyS`&&(e.preventDefault(),this.screenshot().catch(or)),e.ctrlKey||e.metaKey||e.altKey))return;e.key===`Escape`&&!p(`help`).open&&this.cancel();let t=ar[e.key];t&&!p(t).hidden&&p(t).click()}toggle(e){return this.changed(),g(e)}setMode(e){this.controls.mode=e,m(p(`orbit`),e===`orbit`),m(p(`fly`),e===`fly`),this.canvas.focus()}setShow(e){this.show=e,p(`show`).value=e,this.changed()}get chosen(){return Number(p(`camera`).value)}set chosen(e){p(`camera`).value=String(e)}fillCameras(){p(`cameras`).hidden=!this.cameras.length,p(`exposure`).hidden=!this.cameras.some(e=>e.correction),p(`beside`).hidden=!this.cameras.some(e=>e.photograph);let e=p(`camera`);this.cameras.forEach((t,n)=>e.add(new Option(t.name+(t.heldOut?` · held out`:``),`${n}`))),this.chosen=Math.max(0,this.cameras.findIndex(e=>e.heldOut))}jump(e){this.cameras.length&&(this.chosen=(e+this.cameras.length)%this.cameras.length,this.go(this.cameras[this.chosen]),this.setPhotograph())}toggleBeside(){this.toggle(`beside`)?this.cameras[this.chosen].photograph?this.jump(this.chosen):this.jump(this.cameras.findIndex(e=>e.photograph)):this.setPhotograph()}setPhotograph(){let{photograph:e}=this.cameras[this.chosen],t=h(p(`beside`));if(p(`photograph`).hidden=!t,!t)return;let n=p(`photograph-image`);n.removeAttribute(`src`),p(`photograph-name`).textContent=e?`Photograph`:`No photograph of this camera`;let r=e?this.bundle.photograph(e):null;this.photograph=r,r?.then(e=>this.photograph===r&&(n.src=e),e=>q(i(e).message))}async screenshot(){let e=this.view(),t=await this.renderer.read(e,this.options(!0)),n=new OffscreenCanvas(e.width,e.height);n.getContext(`2d`)?.putImageData(t,0,0),te(this.fileName(`png`),await n.convertToBlob({type:`image/png`})),this.changed()}async share(){history.replaceState(null,``,`${location.pathname}${location.search}${$e(this.shared())}`);try{await navigator.clipboard.writeText(location.href),q(`The link to this view was copied.`)}catch{q(`The link to this view is in the address bar.`)}}},cr=[171,75,84,88,32,50,48,187,13,10,26,10],lr={145:`bc7`,37:`uint8`,97:`fp16`},ur={bc7:{side:4,bytes:16},uint8:{side:1,bytes:4},fp16:{side:1,bytes:8}},dr=23552,fr=16384,pr=32768;function mr(e,t){let n=e.byteOffset%2?e.slice():e;return new Uint16Array(n.buffer,n.byteOffset,n.byteLength/2).findIndex((e,n)=>t&&n%4==3?e>fr&&e!==pr:(e&32767)>dr)}var hr=e=>ur[e];function gr(e,t){let n=new DataView(e);if(e.byteLength<104||cr.some((e,t)=>n.getUint8(t)!==e))throw new o(`atlas.ktx2 is not a KTX2 file.`);let r=e=>n.getUint32(e,!0),[i,a,s,c,l]=[r(20),r(24),r(32),r(40),r(44)],u=lr[r(12)];if(u!==t.format||i!==t.width||a!==t.height||s!==t.layers)throw new o(`atlas.ktx2: format and size are not those of bundle.json.`);let{side:d,bytes:f}=ur[u],p=Math.ceil(i/d)*Math.ceil(a/d)*f,m=Number(n.getBigUint64(80,!0)),h=Number(n.getBigUint64(88,!0));if(c!==1||m+h>e.byteLength)throw new o(`atlas.ktx2 is truncated.`);if(l!==0)throw new o(`atlas.ktx2 is compressed by a scheme (${l}) that is not known.`);let g=new Uint8Array(e,m,h);if(g.byteLength!==p*s)throw new o(`atlas.ktx2 has not the bytes of its texels.`);let _=u===`fp16`?mr(g,t.alphaScale>0):-1;if(_>=0)throw new o(`atlas.ktx2: texel ${_>>2} is beyond the limits, or is no number.`);return{format:u,width:i,height:a,layers:Array.from({length:s},(e,t)=>g.subarray(t*p,(t+1)*p))}}var _r=class e{value;path;name;constructor(e,t=``,n=``){this.value=e,this.path=t,this.name=n}refuse(e,t){throw new o(`bundle.json: ${this.path}${e} must be ${t}.`)}has(e){return this.value[e]!==void 0&&this.value[e]!==null}part(t){let n=this.value[t];return(typeof n!=`object`||!n||Array.isArray(n))&&this.refuse(t,`an object`),new e(n,`${this.path}${t}.`,t)}number(e){let[t,[n,r]]=[this.value[e],ce[`${this.name}.${e}`]];return typeof t==`number`&&t>=n&&t<=r||this.refuse(e,`a number from ${n} to ${r}`),t}whole(e){let t=this.number(e);return Number.isInteger(t)||this.refuse(e,`a whole number`),t}choice(e,t){let n=this.value[e];return t.includes(n)||this.refuse(e,`one of ${t.join(`, `)}`),n}point(e){let[t,[n,r]]=[this.value[e],ce[`${this.name}.${e}`]];return Array.isArray(t)&&t.length===3&&t.every(e=>typeof e==`number`&&e>=n&&e<=r)||this.refuse(e,`three numbers`),t}list(e,t){let n=this.value[e];return(!Array.isArray(n)||n.length>t)&&this.refuse(e,`a list of at most ${t}`),n}parts(t,n){return this.list(t,n).map((n,r)=>(typeof n==`object`&&n||this.refuse(`${t}.${r}`,`an object`),new e(n,`${this.path}${t}.${r}.`,t)))}wholes(e,t){let[n,[r,i]]=[this.list(e,t),ce[`${this.name}.${e}`]];return n.every(e=>Number.isInteger(e)&&e>=r&&e<=i)||this.refuse(e,`whole numbers from ${r} to ${i}`),n}entries(t){let n=Object.keys(this.value);if(n.length>t)throw new o(`bundle.json: ${this.path} has more than ${t} keys.`);return n.map(t=>[t,new e(this.part(t).value,`${this.path}${t}.`,this.name)])}text(e,t){let n=this.value[e];return typeof n==`string`&&t.test(n)||this.refuse(e,`a text like ${t.source}`),n}},vr=64,yr=16,br=4096,xr=16384,Sr=[1e-12,0xe8d4a51000];function Cr(e){return e.parts(`columns`,vr).map(e=>({name:e.text(`name`,/^[a-z0-9_]{1,20}$/),step:e.has(`step`)?e.number(`step`):null,bytes:e.wholes(`bytes`,yr)}))}function wr(e){let t=e.part(`frame`),[n,r,i]=[t.point(`center`),t.number(`scale`),t.point(`low`)];return{frame:{center:n,scale:r,low:i},columns:Cr(e)}}function Tr(e,t){return{texels:e.whole(`texels`),step:e.number(`step`),pageWidth:e.whole(`page_width`),pageRows:e.whole(`page_rows`),columns:Cr(e),surfelBytes:t}}function Er(e,t,n){return{format:e.choice(`format`,t?[`dct`]:[`bc7`,`uint8`,`fp16`]),width:e.whole(`width`),height:e.whole(`height`),layers:e.whole(`layers`),extent:e.has(`extent`)?e.number(`extent`):3,offset:e.number(`offset`),scale:e.number(`scale`),alphaScale:e.has(`alpha_scale`)?e.number(`alpha_scale`):0,coded:t?Tr(e,n):null}}function Dr(e){let t=e.text(`photographed`,/^[A-Za-z0-9+/]*={0,2}$/),n=()=>{throw new o(`bundle.json: render.photographed must hold places and rates in range.`)},r;try{r=Uint8Array.from(atob(t),e=>e.charCodeAt(0))}catch{return n()}(r.length%16||r.length>16*br)&&n();let i=new DataView(r.buffer),a=Float32Array.from({length:r.length/4},(e,t)=>i.getFloat32(4*t,!0));return a.every((e,t)=>t%4<3?Math.abs(e)<=1e9:e>=Sr[0]&&e<=Sr[1])?a:n()}function Or(t){let n;try{n=JSON.parse(t)}catch{throw new o(`bundle.json cannot be read as JSON.`)}if(typeof n!=`object`||!n||n.format!==`bitymi-bundle`)throw new e(`This is not a bundle`,`bundle.json has not the format ${oe}.`,`Open another folder.`);let r=new _r(n),i=r.text(`version`,/^[0-9]{1,6}\.[0-9]{1,6}$/),a=Number(i.split(`.`)[0]);if(a>6)throw new e(`This bundle is newer than the viewer`,`It has version ${i}; this viewer reads up to 6.x.`,`Update bitymi-ns, and export the page again if this is an exported one.`);let s=r.part(`surfels`),c=r.part(`render`),l=r.part(`bounds`),u=r.has(`world`)?r.part(`world`):null,d=new Map(r.part(`files`).entries(xr).map(([e,t])=>[e,{bytes:t.whole(`bytes`),sha256:t.text(`sha256`,/^[0-9a-f]{64}$/)}])),f=d.has(`surfels.bin`);if(a<6&&!se[i]?.includes(f?`surfels.bin`:`surfels.ply`))throw new e(`This bundle is of a version that is read no longer`,`It has version ${i}.`,`Export it again.`);let p=r.has(`atlas`)?Er(r.part(`atlas`),f,d.get(`surfels.bin`)?.bytes??0):null;return c.has(`prefilter`)&&c.choice(`prefilter`,[`low_pass`]),{version:i,count:s.whole(`count`),viewColor:s.choice(`view_color`,Object.keys(C)),terms:s.has(`terms`)||f?s.whole(`terms`):null,compact:f?wr(s):null,atlas:p,near:c.number(`near`),weightBound:c.number(`weight_bound`),photographed:c.has(`photographed`)?Dr(c):null,background:c.point(`background`),bounds:{min:l.point(`min`),max:l.point(`max`)},up:u?.has(`up`)?u.point(`up`):null,metres:u?.has(`metres_per_unit`)?u.number(`metres_per_unit`):null,files:d}}var kr=(function(){let e=typeof document<`u`&&document.createElement(`link`).relList;return e&&e.supports&&e.supports(`modulepreload`)?`modulepreload`:`preload`})(),Ar=function(e,t){return new URL(e,t).href},jr={},Mr=function(e){return e.pathname.endsWith(`.css`)},Nr=function(e,t,n){if(t in e)return e[t];let r=n();if(!r){e[t]=void 0;return}let i=r.then(()=>{e[t]=void 0},n=>{throw e[t]=void 0,n});return e[t]=i,i},Pr=function(e,t,n){let r=Promise.resolve();if(t&&t.length>0){let e,i=document.querySelector(`meta[property=csp-nonce]`),a=i?.nonce||i?.getAttribute(`nonce`);function o(e){return Promise.all(e.map(e=>Promise.resolve(e).then(e=>({status:`fulfilled`,value:e}),e=>({status:`rejected`,reason:e}))))}function s(e){return import.meta.resolve?new URL(import.meta.resolve(e)):new URL(e,import.meta.url)}r=o(t.map(t=>{t=Ar(t,n);let r=s(t),i=Mr(r);return Nr(jr,r.href,()=>{if(e===void 0){e={all:new Set,styles:new Set};let t=document.getElementsByTagName(`link`);for(let n=t.length-1;n>=0;n--){let r=t[n];e.all.add(r.href),r.rel===`stylesheet`&&e.styles.add(r.href)}}if((i?e.styles:e.all).has(r.href))return;let t=document.createElement(`link`);if(t.rel=i?`stylesheet`:kr,i||(t.as=`script`),t.crossOrigin=``,t.href=r.href,a&&t.setAttribute(`nonce`,a),document.head.appendChild(t),i)return new Promise((e,n)=>{let i=a=>{t.removeEventListener(`load`,i),t.removeEventListener(`error`,i),a.type===`error`?n(Error(`Unable to preload CSS for ${r}`)):e(a)};t.addEventListener(`load`,i),t.addEventListener(`error`,i)})})}).filter(e=>e!==void 0))}function i(e){let t=new Event(`vite:preloadError`,{cancelable:!0});if(t.payload=e,window.dispatchEvent(t),!t.defaultPrevented)throw e}return r.then(t=>{for(let e of t||[])e.status===`rejected`&&i(e.reason);return e().catch(i)})},Fr=1<<26,Ir=e=>[...new Uint8Array(e)].map(e=>e.toString(16).padStart(2,`0`)).join(``),Lr=async e=>Or(await e.manifest());async function Rr(e,t,n,r){let i=t.files.get(n);if(!i)throw new o(`bundle.json does not list ${n}.`);let a=await e.read(n,i.bytes,r),s=globalThis.crypto?.subtle;if(s&&Ir(await s.digest(`SHA-256`,a))!==i.sha256)throw new o(`${n} is altered: its SHA-256 is not the one in bundle.json.`);return a}async function zr(e,t,n,r,i){let a=t.compact?[`surfels.bin`]:[`surfels.ply`,...t.atlas?[`atlas.ktx2`]:[]],s=a.reduce((e,n)=>e+(t.files.get(n)?.bytes??0),0),c=0,l=r=>Rr(e,t,r,e=>n(c+=e,s)),u=n=>{let r=t.files.get(n)?.bytes??0;if(r>67108864)throw new o(`${n} has ${r} bytes, at most ${Fr} are read.`);return Rr(e,t,n,()=>void 0)},d=async()=>t.files.has(`cameras.json`)?new TextDecoder().decode(await u(`cameras.json`)):null,f=new Map,p=e=>{let t=f.get(e)??(async()=>URL.createObjectURL(new Blob([await u(e)],{type:`image/jpeg`})))();return f.set(e,t),t},[,m,h,g]=await Promise.all([r(t),d(),...a.map(l)]);if(!t.compact){let e=t.atlas?gr(g,t.atlas):null;return{info:t,surfels:Ee(h,t),pages:e,later:null,cameras:m,photograph:p}}let{decodeSurfels:_,decodeTexels:v}=await Pr(async()=>{let{decodeSurfels:e,decodeTexels:t}=await import(`./decoder.js`);return{decodeSurfels:e,decodeTexels:t}},[],import.meta.url),y=await _(h,t,i),b=async e=>v(await l(`texels.bin`),e,y,i);return{info:t,surfels:y,pages:null,later:t.atlas?()=>b(t.atlas):null,cameras:m,photograph:p}}var Br=`poster.webp`,Vr=1<<20,Hr=1024,Ur=30,Wr=(e,t)=>String.fromCharCode(...[0,1,2,3].map(n=>e.getUint8(t+n)));function Gr(e){let t=new DataView(e);return e.byteLength<Ur||Wr(t,0)!==`RIFF`||Wr(t,8)!==`WEBP`||Wr(t,12)!==`VP8 `||t.getUint32(4,!0)+8!==e.byteLength?!1:[26,28].map(e=>t.getUint16(e,!0)).every(e=>e>=1&&e<=Hr)}async function Kr(e,t,n,r){return(t.files.get(n)?.bytes??1/0)>r?null:Rr(e,t,n,()=>void 0).catch(()=>null)}async function qr(e,t){let n=await Kr(e,t,Br,Vr);return n&&Gr(n)?new Blob([n],{type:`image/webp`}):null}async function Jr(e,t){let[n,r]=(e=>(t.files.get(e)?.bytes??1/0)<=Fr)(`preview.jpg`)?[`preview.jpg`,`image/jpeg`]:[`preview.png`,`image/png`],i=await Kr(e,t,n,Fr);return i&&new Blob([i],{type:r})}var Yr=16384,Xr={signature:101010256,bytes:22},Zr={signature:33639248,bytes:46},J={signature:67324752,bytes:30},Qr=1<<22,$r=64,ei=/^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$/,Y=e=>new o(`The file is no bundle in one file: ${e}.`);function ti(e,t){let n=new DataView(e.buffer,e.byteOffset,e.length),r=e.length-Xr.bytes;if(r<0||n.getUint32(r,!0)!==Xr.signature||n.getUint16(r+20,!0))throw Y(`it is truncated, or something else`);let[i,a]=[n.getUint32(r+12,!0),n.getUint32(r+16,!0)],o=a+i;if(i>Qr||o!==t-Xr.bytes)throw Y(`its directory is not where it is said to be`);return{begin:a,end:o}}function ni(e,t){let n=new DataView(e.buffer,e.byteOffset,e.length),r=new Map;for(let i=0;i<e.length;){if(i+Zr.bytes>e.length||n.getUint32(i,!0)!==Zr.signature)throw Y(`its directory is damaged`);let[a,o,s]=[20,24,42].map(e=>n.getUint32(i+e,!0)),c=[28,30,32].map(e=>n.getUint16(i+e,!0)),l=n.getUint16(i+10,!0)===0&&a===o;i+=Zr.bytes;let u=new TextDecoder(`latin1`).decode(e.subarray(i,i+c[0]));if(i+=c[0]+c[1]+c[2],i>e.length)throw Y(`its directory is damaged`);if(r.has(u))throw Y(`two parts have one name`);let d=Math.min(t,s+J.bytes+u.length+$r+o);ei.test(u)&&r.set(u,{begin:s,end:d,size:o,stored:l})}return r}function ri(e,t,n){let r=new DataView(e.buffer,e.byteOffset,e.length),i=e.length>=J.bytes&&r.getUint32(0,!0)===J.signature,a=i?J.bytes+r.getUint16(26,!0)+r.getUint16(28,!0):0;if(!i||a>J.bytes+t.length+$r||a+n>e.length)throw Y(`${t} does not lie where its directory says`);return e.slice(a,a+n).buffer}var ii=()=>void 0,ai=`bundle.json`,oi=/^[A-Za-z0-9][A-Za-z0-9._-]{0,99}\.bitymi$/,si=1<<22,ci=`notes.json`,li=1<<18;async function X(t,n){let r;try{r=await fetch(t,n?{headers:{Range:`bytes=${n}`}}:{})}catch{throw new e(`The bundle cannot be reached`,`${t} was not answered.`,`Is the server still running?`)}if(!r.ok){let n=t.split(`/`).pop()??t;throw n===`bundle.json`||n.endsWith(`.bitymi`)?new e(`There is no bundle`,`${t} is not there.`,`Export the scene again with bitymi view.`):new o(`${n} is missing, or is not what bundle.json says.`)}return r}async function Z(e,t,n,r){let i=[],a=0,s=e.body?.getReader();for(;s;){let{done:e,value:c}=await s.read();if(e)break;if(a+c.length>n)throw new o(`${t} has more than ${n} bytes.`);i.push(c),a+=c.length,r(c.length)}let c=new Uint8Array(a);a=0;for(let e of i)c.set(e,a),a+=e.length;return c}var ui=class{url;constructor(e){this.url=e}async read(e,t,n){let r=await Z(await X(this.url+e),e,t,n);if(r.length!==t)throw new o(`${e} is truncated: ${r.length} of ${t} bytes.`);return r.buffer}async manifest(){return this.text(ai,si)}async notes(e){return e?this.text(ci,li):null}async text(e,t){return new TextDecoder().decode(await Z(await X(this.url+e),e,t,ii))}},di=2**32,fi=class e{url;entries;whole;constructor(e,t,n){this.url=e,this.entries=t,this.whole=n}static async open(t,n){let r=await X(t,`-${Yr}`),i=t.split(`/`).pop()??t;if(r.status!==206){let a=Number(r.headers.get(`Content-Length`))||0,o=0,s=await Z(r,i,di,e=>n(o+=e,a)),{begin:c,end:l}=ti(s,s.length);return new e(t,ni(s.subarray(c,l),c),s)}let a=Number(/\/(\d+)$/.exec(r.headers.get(`Content-Range`)??``)?.[1]);if(!(a<di))throw new o(`${i}: the server does not say how long it is.`);let s=await Z(r,i,Yr,ii),{begin:c,end:l}=ti(s,a),u=c-(a-s.length),d=u>=0?s.slice(u,u+l-c):await Z(await X(t,`${c}-${l-1}`),i,l-c,ii);return new e(t,ni(d,c),null)}entry(e){let t=this.entries.get(e);if(!t)throw new o(`The bundle has no ${e}.`);if(!t.stored)throw new o(`${e} is not stored as it is.`);if(t.begin>=t.end)throw new o(`${e} lies beyond the end of the file.`);return t}async read(e,t,n){let{begin:r,end:i,size:a}=this.entry(e);if(a!==t)throw new o(`${e} has ${a} bytes, not ${t}.`);if(this.whole)return n(t),ri(this.whole.subarray(r,i),e,t);let s=await X(this.url,`${r}-${i-1}`);if(s.status!==206)throw new o(`The server sends no ranges of ${this.url} any longer.`);return ri(await Z(s,e,i-r,n),e,t)}async manifest(){return this.text(ai,si)}async notes(){return this.entries.has(ci)?this.text(ci,li):null}async text(e,t){let{size:n}=this.entry(e);if(n>t)throw new o(`${e} has ${n} bytes, at most ${t} are read.`);return new TextDecoder().decode(await this.read(e,n,ii))}},Q=`bitymi/1/`;function pi(){let{ancestorOrigins:e}=location,t=new URLSearchParams(location.hash.slice(1)).get(`embedder`),n=URL.canParse(document.referrer)?new URL(document.referrer).origin:``;return e?.[0]??t??n}var mi=class{origins;parent;viewer=null;last=``;constructor(){let e=document.querySelector(`meta[name=embedders]`)?.content??``;this.origins=new Set([location.origin,...e.split(/\s+/).filter(Boolean)]),this.parent=parent!==window&&this.origins.has(pi())?pi():null,this.parent&&addEventListener(`message`,({source:e,origin:t,data:n})=>{e===parent&&t===this.parent&&this.heed(n)})}ready(e,t){this.viewer=e,this.send(`ready`,{title:t,camera:et(e.shared())})}shown(){if(!this.parent||!this.viewer)return;let e=et(this.viewer.shared()),t=JSON.stringify(e);t!==this.last&&(this.last=t,this.send(`camera`,{camera:e}))}failed(e,t){this.send(`error`,{title:e,message:t})}send(e,t){this.parent&&parent.postMessage({type:Q+e,...t},this.parent)}heed(e){if(typeof e!=`object`||!e)return;let{type:t,id:n,camera:r,file:i,name:a}=e;if(typeof t!=`string`||!t.startsWith(Q))return;let o=e=>this.send(`error`,{id:n,title:`The message is refused`,message:e});if(t===`${Q}load`){if(i!==``&&!(typeof i==`string`&&oi.test(i))){o(`file must be the name of a .bitymi file beside the page, or empty.`);return}let e=new URL(i?`?file=${encodeURIComponent(i)}`:location.pathname,location.href);e.hash=`embedder=${encodeURIComponent(this.parent)}`;let t=e.search===location.search;location.replace(e),t&&location.reload()}else if(!this.viewer)o(`The scene is not shown yet: wait for ready.`);else if(t===`${Q}get-camera`)this.send(`camera`,{id:n,camera:et(this.viewer.shared())});else if(t===`${Q}set-camera`){let e=nt(r);e?this.viewer.apply({...this.viewer.shared(),...e}):o(`camera must have position, right, forward, target and lens.`)}else t===`${Q}list-views`?this.send(`views`,{id:n,views:this.viewer.notes.names}):t===`${Q}go-to-view`?typeof a==`string`&&this.viewer.notes.goTo(a)||o(`name must be that of a saved view.`):o(`There is no such message.`)}},hi=`Chrome and Edge from 113, Safari from 26 and Firefox from 141 have it. Update the browser and the graphics driver, and look whether hardware acceleration is switched on. Pages need https, or an address on this machine.`;async function gi(){let e=navigator.gpu;if(!e)throw new t(`This browser has no WebGPU`,`The viewer draws with WebGPU.`,hi);let n=await e.requestAdapter({powerPreference:`high-performance`});if(!n)throw new t(`No graphics device`,`WebGPU finds nothing here that could draw.`,hi);let r=[`texture-compression-bc`,`float32-blendable`,`float32-filterable`],i=r.filter(e=>n.features.has(e)),{maxTextureDimension2D:a,maxTextureArrayLayers:o,maxStorageBufferBindingSize:s,maxBufferSize:c}=n.limits,{maxComputeWorkgroupsPerDimension:l}=n.limits,{architecture:u,device:d,description:f}=n.info;return{device:await n.requestDevice({requiredFeatures:i,requiredLimits:{maxTextureDimension2D:a,maxTextureArrayLayers:o,maxStorageBufferBindingSize:s,maxBufferSize:c,maxComputeWorkgroupsPerDimension:l}}),blocks:i.includes(r[0]),floats:i.includes(r[1])&&i.includes(r[2]),software:n.info.isFallbackAdapter||/swiftshader|llvmpipe/i.test(`${u} ${d} ${f}`)}}var _i=`Reload the page. If it happens again, update the browser and the graphics driver.`;function vi(t,r){t.addEventListener(`uncapturederror`,({error:t})=>{t instanceof GPUOutOfMemoryError?r(n(`The graphics device has not enough memory for it.`)):r(new e(`The graphics device reports an error`,t.message,_i))}),t.lost.then(({reason:t,message:n})=>{t!==`destroyed`&&r(new e(`The graphics device was lost`,n||`The browser does not say why.`,_i))})}var yi=19,bi=12,xi=2**30,Si=4,Ci=.5,wi=e=>e.width*e.height*e.layers;function Ti({count:e,terms:t,viewColor:n,compact:r,atlas:i,files:a}){let o=C[n],s=4*(24*e+o*(t??0));if(r){let n=8*(yi*e+o*(t??0)),r=i?bi*(i.coded?.texels??0)+8*wi(i):0;return s+Math.max(n,r)}return s+[`surfels.ply`,`atlas.ktx2`].reduce((e,t)=>e+(a.get(t)?.bytes??0),0)}function Ei(e,t,r=Si){let{count:i,terms:a,viewColor:o,atlas:s}=e,c=Math.max(96*i,4*C[o]*(a??0)),l=s?Math.max(s.width,s.height):0,u=s?.layers??0;if(c<=Math.min(t.maxStorageBufferBindingSize,t.maxBufferSize)&&i<=64*t.maxComputeWorkgroupsPerDimension&&l<=t.maxTextureDimension2D&&u<=t.maxTextureArrayLayers&&Ti(e)<=Ci*r*xi)return;let d=s?`, ${u} ${u===1?`page`:`pages`} of ${s.width} x ${s.height} texels`:``;throw n(`It has ${i.toLocaleString(`en`)} surfels${d}.`)}var Di=[.75,1.5],[Oi,ki]=[.5,2],[Ai,ji]=[.6,1/3],Mi=.58,Ni=[1/64,64],Pi=3,Fi=3;function Ii(e,t){let n=[];for(let r=0;r<e.length;r+=4){let i=t.project([e[r],e[r+1],e[r+2]]);i&&n.push(Math.sqrt(t.fx*t.fy)/(i[2]*e[r+3]))}return n.length?(n.sort((e,t)=>e-t),Math.min(Math.max(n[n.length-1>>1],Ni[0]),Ni[1])):1}var Li=e=>e<ji;function Ri(e,t,n){let{position:r,right:i,down:a,forward:o}=t.pose,[s,c]=[[1/0,1/0],[-1/0,-1/0]];for(let t=0;t<e.length;t+=24){let l=[e[t]-r[0],e[t+1]-r[1],e[t+2]-r[2]],u=D(l,o);if(!(u>n))continue;let d=Pi*Math.exp(Math.max(e[t+x.logScale],e[t+x.logScale+1]));for(let[e,t]of[i,a].entries()){let n=D(l,t)/u,r=u>d?d*(1+Math.abs(n))/(u-d):1/0;s[e]=Math.min(s[e],n-r),c[e]=Math.max(c[e],n+r)}}let l=(e,t,n,r)=>{let i=Math.floor(Math.min(Math.max(s[e]*t+n-Fi,0),r-1));return[i,Math.ceil(Math.max(Math.min(c[e]*t+n+Fi,r),i+1))]},[u,d]=l(0,t.fx,t.cx,t.width),[f,p]=l(1,t.fy,t.cy,t.height);return[u,f,d,p]}function zi(e,t,n,r){let[i,a]=Di;if(i<=e&&e<=a)return{samples:1,photoPixel:1};let o=Math.floor(Math.sqrt(r/Math.max(t,1))),s=e>=Ai?1:e>=ji?2:Math.max(3,Math.ceil(Mi/e)),c=Math.max(1,Math.min(s,n,o)),l=c*e;return c>1||(Oi<e&&e<i?l=Oi**(Math.log(i/e)/Math.log(i/Oi)):a<e&&e<ki&&(l=ki**(Math.log(e/a)/Math.log(ki/a)))),{samples:c,photoPixel:l}}var $={partition:0,rotation:0,selector:0,alpha:0,index2:0},Bi=[{...$,subsets:3,partition:4,color:4,shared:`endpoint`,index:3},{...$,subsets:2,partition:6,color:6,shared:`subset`,index:3},{...$,subsets:3,partition:6,color:5,shared:`none`,index:2},{...$,subsets:2,partition:6,color:7,shared:`endpoint`,index:2},{...$,subsets:1,rotation:2,selector:1,color:5,alpha:6,shared:`none`,index:2,index2:3},{...$,subsets:1,rotation:2,color:7,alpha:8,shared:`none`,index:2,index2:2},{...$,subsets:1,color:7,alpha:7,shared:`endpoint`,index:4},{...$,subsets:2,partition:6,color:5,alpha:5,shared:`endpoint`,index:2}],Vi={2:[0,21,43,64],3:[0,9,18,27,37,46,55,64],4:[0,4,9,13,17,21,26,30,34,38,43,47,51,55,60,64]},Hi=[52428,34952,61166,60616,51328,65260,65224,60544,51200,65516,65152,59392,65512,65280,65520,61440,63248,142,28928,2254,140,29456,12544,36046,2188,12560,26214,13932,6120,4080,29070,14748,43690,61680,23130,13260,15420,21930,38550,42330,29646,5064,12876,15324,27030,49980,39270,1632,626,1252,20032,10016,51510,37740,14790,25500,37686,40134,33150,59160,52464,4044,30532,60962],Ui=[2858963024,1784303680,1515864576,1414570152,2779054080,2694860880,1431675040,1515868240,2857697280,2857719040,2863289600,2425393296,2492765332,2762253476,2846200912,705315408,2777960512,172118100,2779096320,1436590240,2829603924,1785348160,2762231808,437912832,5285028,2862977168,342452500,1768494080,2693105056,2860651540,1352967248,1784283648,2846195712,1351655592,2829094992,606348324,11162880,613566756,608801316,1352993360,1342874960,2863285316,1717960704,2778768800,1352683680,1764256040,1152035396,1717986816,2856600644,1420317864,2508232064,2526451200,2824098984,2157286784,2853442580,2526412800,2863272980,2689618080,2695210400,2516582400,1082146944,2846402984,2863311428,709513812],Wi=[15,15,15,15,15,15,15,15,15,15,15,15,15,15,15,15,15,2,8,2,2,8,8,15,2,8,2,2,8,8,2,2,15,15,6,8,2,8,15,15,2,8,2,2,2,15,15,6,6,2,6,8,15,15,2,2,15,15,15,15,15,2,2,15],Gi=[3,3,15,15,8,3,15,15,8,8,6,6,6,5,3,3,3,3,8,15,3,3,6,10,5,8,8,6,8,5,15,15,8,15,3,5,6,10,8,15,15,3,15,5,15,15,15,15,3,15,5,5,5,8,5,10,5,10,8,13,15,12,3,3],Ki=[15,8,8,3,15,15,3,8,15,15,15,15,15,15,15,8,15,8,15,3,15,8,15,8,3,15,6,10,15,15,10,8,15,3,15,10,10,8,9,10,6,15,8,15,3,6,6,8,15,3,15,15,15,15,15,15,15,15,15,15,3,15,15,8],qi=class{data;start;at=0;constructor(e,t){this.data=e,this.start=t}take(e){let t=0;for(let n=0;n<e;n++,this.at++)t|=(this.data[this.start+(this.at>>3)]>>(this.at&7)&1)<<n;return t}},Ji=(e,t,n)=>e===2?Hi[t]>>>n&1:e===3?Ui[t]>>>2*n&3:0,Yi=(e,t,n)=>n===0?!0:e===2?n===Wi[t]:e===3&&(n===Gi[t]||n===Ki[t]),Xi=(e,t)=>{let n=e<<8-t;return n|n>>t},Zi=(e,t,n)=>(64-n)*e+n*t+32>>6;function Qi(e,t){let n=Array.from({length:t.subsets},()=>[[0,0,0,255],[0,0,0,255]]),r=t.alpha?4:3;for(let i=0;i<r;i++)for(let r of n)for(let n of r)n[i]=e.take(i<3?t.color:t.alpha);let i=t.shared===`none`?0:1;for(let a of n){let n=t.shared===`subset`?e.take(1):0;for(let o of a){let a=t.shared===`endpoint`?e.take(1):n;for(let e=0;e<r;e++){let n=e<3?t.color:t.alpha;o[e]=Xi(i?o[e]<<1|a:o[e],n+i)}}}return n}function $i(e,t,n,r,i){let a=new qi(e,t),o=0;for(;o<8&&!a.take(1);)o++;let s=Bi[o];if(!s){for(let e=0;e<4;e++)n.fill(0,r+e*i,r+e*i+16);return}let c=a.take(s.partition),l=a.take(s.rotation),u=a.take(s.selector),d=Qi(a,s),f=e=>Array.from({length:16},(t,n)=>a.take(e-+!!Yi(s.subsets,c,n))),p=f(s.index),m=s.index2?f(s.index2):p,[h,g]=u?[m,p]:[p,m],_=Vi[u?s.index2:s.index],v=Vi[s.index2&&!u?s.index2:s.index];for(let e=0;e<16;e++){let[t,a]=d[Ji(s.subsets,c,e)],o=r+(e>>2)*i+(e&3)*4;for(let r=0;r<3;r++)n[o+r]=Zi(t[r],a[r],_[h[e]]);if(n[o+3]=Zi(t[3],a[3],v[g[e]]),l){let e=n[o+l-1];n[o+l-1]=n[o+3],n[o+3]=e}}}function ea(e,t,n){let r=new Uint8Array(t*n*4),i=t*4;for(let a=0,o=0;a<n;a+=4)for(let n=0;n<t;n+=4,o+=16)$i(e,o,r,a*i+n*4,i);return r}var ta=-1e4,na={width:1,height:1,layers:[new Uint8Array(4)],format:`uint8`};function ra(e,t,n){let r=[];return n.forEach((e,t)=>{e!==null&&r.push({binding:t,resource:e instanceof GPUBuffer?{buffer:e}:e})}),e.createBindGroup({layout:t,entries:r})}var ia=class{graphics;programs;info;surfels;count;shown;frame;visible;draws;layers;drawn;decoded;pages;complete;atlas;coarser=null;device;preparing;rounds=[];sharing;blocks;stored;constructor(e,t,n,r,i){this.graphics=e,this.programs=t,this.info=n,this.surfels=r;let{device:a}=e;this.device=a,this.count=this.shown=r.count,this.blocks=Math.ceil(Math.max(1,this.count)/he);let{STORAGE:o,UNIFORM:s,COPY_DST:c,INDIRECT:l}=GPUBufferUsage,u=Math.max(1,this.count),d=this.stored=this.upload(r.words,o),f=this.upload(r.terms,o),p=this.empty(96*u,o),m=[0,1].map(()=>this.empty(4*u,o)),h=[0,1].map(()=>this.empty(4*u,o)),g=this.empty(64*this.blocks,o);this.frame=this.empty(160,s|c),this.visible=this.empty(4,o|c),this.draws=this.empty(1024,o|l);let _=new Uint32Array(4096);for(let e=0;e<64;e++)_[e*256/4]=e;this.layers=this.upload(_,s);let v=(e,...t)=>ra(a,e,t);this.preparing=v(t.prepare.getBindGroupLayout(0),this.frame,d,f,p,m[0],h[0],this.visible);for(let e=0;e<8;e++){let[n,r]=[e%2,1-e%2],i=[this.upload(new Uint32Array([this.count,this.blocks,4*e,0]),s),m[n],h[n],m[r],h[r],g],a={count:[0,1,5],scan:[0,5],scatter:[0,1,2,3,4,5]},o=Ke.map(e=>[e,v(t.sort[e].getBindGroupLayout(0),...i.map((t,n)=>a[e].includes(n)?t:null))]);this.rounds.push(Object.fromEntries(o))}this.sharing=v(t.shareOut.getBindGroupLayout(0),this.frame,this.visible,this.draws),this.drawn=v(t.layouts[0],this.frame,d,p,h[0],this.visible),this.decoded=i?.format===`bc7`&&!e.blocks,this.complete=i!==null||n.atlas===null,this.atlas=this.texture(i),this.pages=this.boundPages()}get atlasSize(){return[this.atlas.width,this.atlas.height]}get alphaScale(){return this.info.atlas?.alphaScale??0}get detail(){return this.complete?this.surfels.means?2:1:0}hide(e){let t=e?this.surfels.words.slice():this.surfels.words;e?.forEach((e,n)=>{e||(t[n*24+x.opacityLogit]=ta)}),this.shown=e?e.reduce((e,t)=>e+t,0):this.count,this.count&&this.device.queue.writeBuffer(this.stored,0,t)}setTexels(e){this.atlas=this.texture(e),this.coarser=null,this.complete=!0,this.pages=this.boundPages()}boundPages(){let[e,t]=[this.atlas,this.coarser??this.atlas].map(e=>e.createView({dimension:`2d-array`})),n=this.device.createSampler({magFilter:`linear`,minFilter:`linear`});return ra(this.device,this.programs.layouts[1],[e,n,t])}makeCoarser(){if(this.coarser||!this.complete)return;let{width:e,height:t,depthOrArrayLayers:n}=this.atlas,r=this.atlas.format===`rgba16float`?`rgba16float`:`rgba8unorm`,i=[Math.max(1,e>>1),Math.max(1,t>>1)],a=this.device.createTexture({size:[...i,n],format:r,mipLevelCount:Math.max(...i)>1?2:1,usage:GPUTextureUsage.TEXTURE_BINDING|GPUTextureUsage.RENDER_ATTACHMENT}),o=this.programs.halve(r,this.alphaScale>0),s=this.device.createCommandEncoder(),c=(e,t,n)=>e.createView({dimension:`2d`,baseMipLevel:t,mipLevelCount:1,baseArrayLayer:n,arrayLayerCount:1});for(let e=0;e<a.mipLevelCount;e++)for(let t=0;t<n;t++){let n=e?c(a,e-1,t):c(this.atlas,0,t),r=s.beginRenderPass({colorAttachments:[{view:c(a,e,t),loadOp:`clear`,storeOp:`store`}]});r.setPipeline(o),r.setBindGroup(0,ra(this.device,o.getBindGroupLayout(0),[n])),r.draw(3),r.end()}this.device.queue.submit([s.finish()]),this.coarser=a,this.pages=this.boundPages()}empty(e,t){let{maxBufferSize:r,maxStorageBufferBindingSize:i}=this.device.limits;if(e>r||t&GPUBufferUsage.STORAGE&&e>i)throw n(`It needs ${(e/1e6).toFixed(0)} MB of graphics memory in one piece.`);return this.device.createBuffer({size:e,usage:t})}upload(e,t){let n=this.empty(Math.max(96,e.byteLength),t|GPUBufferUsage.COPY_DST);return e.byteLength&&this.device.queue.writeBuffer(n,0,e),n}texture(e){let{width:t,height:n,layers:r,format:i}=e??na,a=i===`bc7`&&!this.graphics.blocks,o={bc7:a?`rgba8unorm`:`bc7-rgba-unorm`,uint8:`rgba8unorm`,fp16:`rgba16float`},s=this.device.createTexture({size:[t,n,r.length],format:o[i],usage:GPUTextureUsage.TEXTURE_BINDING|GPUTextureUsage.COPY_DST}),{side:c,bytes:l}=hr(a?`uint8`:i);return r.forEach((e,r)=>{let i=a?ea(e,t,n):e;this.device.queue.writeTexture({texture:s,origin:[0,0,r]},i,{bytesPerRow:Math.ceil(t/c)*l,rowsPerImage:Math.ceil(n/c)},[t,n,1])}),s}encodeSorting(e){let t=e.beginComputePass(),n=(e,n,r)=>{t.setPipeline(e),t.setBindGroup(0,n),t.dispatchWorkgroups(r)};n(this.programs.prepare,this.preparing,Math.ceil(Math.max(1,this.count)/64));for(let e of this.rounds)n(this.programs.sort.count,e.count,this.blocks),n(this.programs.sort.scan,e.scan,1),n(this.programs.sort.scatter,e.scatter,this.blocks);n(this.programs.shareOut,this.sharing,1),t.end()}},aa=1<<22,oa=112,sa=[1,0,0,0,0,1,0,0,0,0,1,0],ca=64,la=class{graphics;programs;scene;target=null;screen;smooth;constructor(e,t,n){this.graphics=e,this.programs=t,this.scene=n;let{device:r}=e;this.screen=r.createBuffer({size:oa,usage:GPUBufferUsage.UNIFORM|GPUBufferUsage.COPY_DST}),this.smooth=r.createSampler({magFilter:`linear`,minFilter:`linear`})}get coarse(){return!this.graphics.floats}get largestSide(){return this.graphics.device.limits.maxTextureDimension2D}targetOf(e,t,n,r){let i=this.target;if(i&&i.samples===n&&i.width===e&&i.height===t&&i.format===r)return i;i?.sums.destroy(),i?.before.destroy();let{device:a}=this.graphics,{RENDER_ATTACHMENT:o,COPY_SRC:s,COPY_DST:c,TEXTURE_BINDING:l}=GPUTextureUsage,u=n=>a.createTexture({size:[e,t],format:r,usage:n}),d=u(o|s|l),f=u(l|c),p=a.createBindGroup({layout:this.programs.layouts[2],entries:[{binding:0,resource:{buffer:this.scene.layers,size:16}},{binding:1,resource:f.createView()}]});return this.target={width:e,height:t,samples:n,format:r,sums:d,before:f,batch:p},this.target}samplingOf(e,t){let n=[0,0,e.width,e.height],{info:r,surfels:i}=this.scene;if(!r.photographed?.length)return[{samples:1,photoPixel:1},n];let a=Ii(r.photographed,e),o=Li(a)&&t.fine?Ri(i.words,e.from(i.origin),r.near):n,[s,c,l,u]=o,[d,f]=[l-s,u-c],p=t.fine?Math.max(1,Math.floor(this.largestSide/Math.max(d,f))):1,m=zi(a,d*f,p,aa);return[m,m.samples>1?o:n]}setFrame(e,t,n,r,i){let{info:a,surfels:o,atlasSize:s,alphaScale:c,count:l}=this.scene,u=new ArrayBuffer(160),[d,f]=[new Float32Array(u),new Uint32Array(u)],{right:p,down:m,forward:h}=e.pose;[p,m,h].forEach((e,t)=>d.set(e,S.rotation+4*t));let g=e=>e.map((e,t)=>e-o.origin[t]),{position:_}=e.pose;d.set([...g(_),c],S.center),d.set([...g(i.held??_),i.farthest],S.colorCenter),d.set([e.fx,e.fy,e.cx,e.cy],S.lens),d.set([t,n,a.near,a.weightBound],S.size),d.set([a.atlas?.offset??0,a.atlas?.scale??1,...s],S.offset),f.set([l,o.kind,i.layers,Ge[i.show],+!!i.residuals],S.surfels),d[S.photoPixel]=r,f[S.detail]=this.scene.detail,this.graphics.device.queue.writeBuffer(this.scene.frame,0,u)}encode(e,t,n){let{scene:r,programs:i}=this,[{samples:a,photoPixel:o},s]=this.samplingOf(t,n),c=t.part(...s),[l,u]=[a*c.width,a*c.height],d=n.fine&&this.graphics.floats?`rgba32float`:`rgba16float`,f=this.targetOf(l,u,a,d);o<1&&r.makeCoarser(),this.setFrame(c.scaledTo(l,u),l,u,o,n),e.clearBuffer(r.visible),r.encodeSorting(e);let p=i.draw(f.format,n.show===`overdraw`?`count`:`blend`),m=f.sums.createView();for(let t=0;t<n.layers;t++){t&&e.copyTextureToTexture({texture:f.sums},{texture:f.before},[l,u]);let n=e.beginRenderPass({colorAttachments:[{view:m,loadOp:t?`load`:`clear`,storeOp:`store`,clearValue:[0,0,0,1]}]});n.setPipeline(p),n.setBindGroup(0,r.drawn),n.setBindGroup(1,r.pages),n.setBindGroup(2,f.batch,[t*256]),n.drawIndirect(r.draws,16*t),n.end()}return{target:f,width:t.width,height:t.height,part:s}}encodePresent(e,t,n,r){let{device:i}=this.graphics,{target:a,width:o,height:s,part:c}=t,l=this.programs.present(n.format),u=new ArrayBuffer(oa),[d,f]=[new Float32Array(u),new Uint32Array(u)];d.set([...r.background,1,n.width,n.height]),f[6]=Ge[r.show],d.set([ca,o,s],7),f.set([c[0],c[1],a.samples],10),d.set(r.correction??sa,16),i.queue.writeBuffer(this.screen,0,u);let p=ra(i,l.getBindGroupLayout(0),[this.screen,a.sums.createView(),this.smooth]),m=e.beginRenderPass({colorAttachments:[{view:n.createView(),loadOp:`clear`,storeOp:`store`}]});m.setPipeline(l),m.setBindGroup(0,p),m.draw(3),m.end()}draw(e,t,n,r){let{queue:i}=this.graphics.device,a=this.graphics.device.createCommandEncoder(),[o,s]=[t.width,t.height].map(e=>Math.max(1,Math.round(e*n))),c=this.encode(a,e.scaledTo(o,s),r);return this.encodePresent(a,c,t,r),i.submit([a.finish()]),i.onSubmittedWorkDone()}async depths(e,t){let n=this.graphics.device.createCommandEncoder(),{width:r,height:i,format:a,sums:o}=this.encode(n,e,{...t,show:`depth`}).target,s=a===`rgba32float`?16:8,c=await this.rowsOf(n,o,s),l=new Float32Array(r*i);for(let e=0;e<l.length;e++){let n=c[Math.floor(e/r)],i=new DataView(n.buffer,n.byteOffset+e%r*s,s),a=e=>s===16?i.getFloat32(4*e,!0):ua(i.getUint16(2*e,!0)),o=1-a(3),u=a(0)/o*t.farthest;l[e]=o>=.5&&u<1/0?u:1/0}return{width:r,height:i,depth:l}}async read(e,t){let{device:n}=this.graphics,r=[e.width,e.height],i=GPUTextureUsage.RENDER_ATTACHMENT|GPUTextureUsage.COPY_SRC,a=n.createTexture({size:r,format:`rgba8unorm`,usage:i}),o=n.createCommandEncoder();this.encodePresent(o,this.encode(o,e,t),a,t);let s=new ImageData(...r);return(await this.rowsOf(o,a,4)).forEach((t,n)=>s.data.set(t,4*e.width*n)),a.destroy(),s}async rowsOf(e,t,n){let{device:r}=this.graphics,{width:i,height:a}=t,o=Math.ceil(n*i/256)*256,s=GPUBufferUsage.COPY_DST|GPUBufferUsage.MAP_READ,c=r.createBuffer({size:o*a,usage:s});e.copyTextureToBuffer({texture:t},{buffer:c,bytesPerRow:o},[i,a]),r.queue.submit([e.finish()]),await c.mapAsync(GPUMapMode.READ);let l=c.getMappedRange().slice(0);return c.destroy(),Array.from({length:a},(e,t)=>new Uint8Array(l,t*o,n*i))}},ua=e=>{let t=e>>10;return t>30?e&1023?NaN:1/0:t?2**(t-25)*(1024+(e&1023)):2**-24*e};async function da(){let t=new URLSearchParams(location.search).get(`file`)??document.querySelector(`meta[name=bundle]`)?.content??``;if(!t)return new ui(`bundle/`);if(!oi.test(t))throw new e(`This is not the name of a bundle in one file`,`It must lie beside the page, and have letters, digits, dots and dashes before .bitymi.`,`Change the address.`);return fi.open(t,Mt)}async function fa(){let e=new URLSearchParams(location.search).get(`file`);if(e)return{title:e.replace(/\.bitymi$/,``),notes:!1};try{let{title:e,notes:t}=await(await fetch(`view.json`)).json();return{title:typeof e==`string`?e.slice(0,120):`Scene`,notes:t===!0}}catch{return{title:`Scene`,notes:!1}}}async function pa(e,t){try{let n=await e.notes(t);if(n!==null)return bt(n)}catch(e){q(`notes.json cannot be used: ${r(e)}`)}return it()}async function ma(e,n){let r=await e,i=await Lr(r);return n.catch(async e=>{e instanceof t&&await Lt(e,[await Jr(r,i),await qr(r,i)],(await fa()).title)}),await Promise.race([n,null]),rt(location.hash)||qr(r,i).then(zt),zr(r,i,Mt,async()=>{let{deviceMemory:e}=navigator;Ei(i,(await n).device.limits,e)},q)}var ha=e=>{e instanceof t||K(e)};async function ga(){let e=gi(),t=da(),n=ma(t,e);n.catch(ha);let r=await e,{device:i}=r;vi(i,K);let a=new Ye(i),o=await n,s=new ia(r,a,o.info,o.surfels,o.pages),c=p(`canvas`);r.software&&q(`No graphics card draws here: the processor does, slowly.`),s.decoded&&q(`This device draws no BC7 textures: the texture was decoded, at four times the graphics memory.`);let{title:l,notes:u}=await fa();document.title=p(`title`).textContent=l;let f=await pa(await t,u);Ft();let m=new la(r,a,s),h=new sr(c,d(c,m,r),m,o,f,()=>_a.shown());h.start(),_a.ready(h,document.title),o.later&&(s.setTexels(await o.later()),h.changed())}var _a=new mi;Pt((e,t)=>_a.failed(e,t)),document.documentElement.dataset.state=`loading`,p(`page-late`).hidden=!0,addEventListener(`unhandledrejection`,({reason:e})=>K(e)),addEventListener(`error`,({error:e})=>e&&K(e)),ga().catch(ha);export{e as t};