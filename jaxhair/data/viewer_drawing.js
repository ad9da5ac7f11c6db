// Drawing with WebGL 2: hairs as ribbons that face the eye, smooth between the points, lit after
// Kajiya and Kay as in jaxhair/shading.py; obstacles; shadows by a depth map seen from the light.

const BACKGROUND = [0.914, 0.922, 0.933];
const MAP = 1024; // pixels of the shadow map
const ROW = 1024; // points in a row of the texture that holds the hairs' points
const HALF_TAN = Math.tan((28 / 2) * Math.PI / 180); // of the field of view

const LIT = `
uniform sampler2D shade;
uniform mat4 light;
uniform float radius;
vec3 linear(vec3 c) { return pow(c, vec3(2.2)); }
vec3 screen(vec3 c) { return pow(clamp(c, 0., 1.), vec3(1. / 2.2)); }
// The part of the light that gets here: less the farther behind the first thing that it meets.
float lit(vec3 place, float bias) {
  vec3 p = (light * vec4(place, 1.)).xyz * .5 + .5;
  float sum = 0.;
  for (int i = 0; i < 5; i++) {
    vec2 at = p.xy + (i < 4 ? vec2(i % 2, i / 2) - .5 : vec2(0)) * 5. / ${MAP}.;
    float behind = (p.z - texture(shade, at).r) * 4. - bias;
    sum += exp(-max(behind, 0.) * 22.);
  }
  return sum / 5.;
}`;

const HAIR_VERTEX = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D hairs, each; // each: last point, where it is cut off (in points), shade
uniform int points, pieces;
uniform mat4 camera;
uniform vec4 eye; // w = 0: a direction, for the light
uniform float width, pixel;
uniform bool flatEdges;
out vec3 place, tangent;
out float across, level, along, tint;
vec4 fetch(sampler2D from, int k) { return texelFetch(from, ivec2(k % ${ROW}, k / ${ROW}), 0); }
void main() {
  // All hairs are one strip, joined by triangles without area, since instances are slow without a
  // graphics card.
  int corners = 2 * ((points - 1) * pieces + 1), which = gl_VertexID / (corners + 2);
  int corner = clamp(gl_VertexID % (corners + 2) - 1, 0, corners - 1);
  vec4 hair = fetch(each, which);
  int last = int(hair.x), first = which * points;
  float u = min(float(corner >> 1) / float(pieces), hair.y);
  int i = min(int(u), last - 1);
  float t = u - float(i);
  vec4 before = fetch(hairs, first + max(i - 1, 0)), start = fetch(hairs, first + i);
  vec4 end = fetch(hairs, first + i + 1), after = fetch(hairs, first + min(i + 2, last));
  vec3 chord = (end - start).xyz;
  vec3 leave = (end - before).xyz / 2., arrive = (after - start).xyz / 2.;
  // at the ends, the parabola through three points keeps the curl
  if (i == 0) leave = last > 1 ? 2. * chord - arrive : chord;
  if (i + 1 == last) arrive = last > 1 ? 2. * chord - (end - before).xyz / 2. : chord;
  vec3 a = -2. * chord + leave + arrive, b = 3. * chord - 2. * leave - arrive;
  place = start.xyz + t * (leave + t * (b + t * a));
  vec3 rate = leave + t * (2. * b + 3. * t * a);
  tangent = dot(rate, rate) > 0. ? normalize(rate) : vec3(0, 0, 1);
  level = flatEdges ? start.w : mix(start.w, end.w, t);
  vec3 towards = eye.w == 0. ? eye.xyz : eye.xyz - place;
  vec3 side = cross(tangent, towards);
  side = dot(side, side) > 0. ? normalize(side) : vec3(0);
  across = float(corner & 1) * 2. - 1.;
  along = u / float(last);
  tint = hair.z;
  float fine = eye.w == 0. ? pixel : pixel * length(towards);
  // at least about a pixel, or far hair would flicker; at most four, or near hair would be ribbons
  float half_ = clamp(width * (1. - .5 * smoothstep(.75, 1., along)), 1.1 * fine, 4. * fine) / 2.;
  gl_Position = camera * vec4(place + across * half_ * side, 1.);
}`;

const HAIR_FRAGMENT = `#version 300 es
precision highp float;
${LIT}
uniform vec4 eye;
uniform vec3 lamp, background, color, middle;
uniform bool plain;
uniform sampler2D ramp;
in vec3 place, tangent;
in float across, level, along, tint;
out vec4 result;
void main() {
  vec3 t = normalize(tangent), e = normalize(eye.xyz - place);
  float te = dot(t, e), tl = dot(t, lamp);
  float fill = sqrt(max(1. - te * te, 0.)), diffuse = sqrt(max(1. - tl * tl, 0.));
  float cone = clamp(diffuse * fill - tl * te, 0., 1.);
  float light = lit(place, .01);
  float round_ = 1. - .35 * across * across;
  vec3 base = linear(plain ? color : texture(ramp, vec2((level * 255. + .5) / 256., .5)).rgb);
  base *= plain ? tint * (.8 + .35 * along) : mix(1., tint, .4);
  vec3 lit_ = base * (.10 + .30 * fill * (.4 + .6 * light) + .85 * diffuse * light) * round_;
  // two highlights, the second wider and of the hair's own colour
  lit_ += (plain ? .22 : .06) * pow(cone, 60.) * light * round_;
  lit_ += (plain ? .9 : .15) * base * pow(cone, 12.) * light * round_;
  float away = dot(place - middle, normalize(middle - eye.xyz)) / radius;
  result = vec4(mix(screen(lit_), background, .22 * smoothstep(-.6, 1., away)), 1.);
}`;

const SHAPE_VERTEX = `#version 300 es
precision highp float;
uniform mat4 camera;
uniform vec3 offset;
layout(location = 0) in vec3 vertex;
layout(location = 1) in vec3 perpendicular;
out vec3 place, normal;
void main() {
  place = vertex + offset;
  normal = perpendicular;
  gl_Position = camera * vec4(place, 1.);
}`;

const SHAPE_FRAGMENT = `#version 300 es
precision highp float;
${LIT}
uniform vec4 eye;
uniform vec3 lamp, background;
in vec3 place, normal;
out vec4 result;
void main() {
  vec3 n = normalize(normal), e = normalize(eye.xyz - place);
  n *= dot(n, e) < 0. ? -1. : 1.;
  float direct = max(dot(n, lamp), 0.) * lit(place, .02);
  vec3 c = vec3(.50, .47, .45) * (.36 + .14 * n.z + .85 * direct);
  float fade = smoothstep(1.1, 2.5, length(place) / radius); // a floor has no end
  result = vec4(mix(screen(c), background, fade), 1.);
}`;

const DEPTH_FRAGMENT = `#version 300 es
precision highp float;
void main() {}`;

// Draws into a canvas. Throws where there is no WebGL 2.
function createDrawing(canvas, of) {
  const gl = canvas.getContext("webgl2", { antialias: true, powerPreference: "high-performance" });
  if (!gl) throw new Error("no WebGL 2");
  const programs = {
    hair: program(gl, HAIR_VERTEX, HAIR_FRAGMENT),
    hairDepth: program(gl, HAIR_VERTEX, DEPTH_FRAGMENT),
    shape: program(gl, SHAPE_VERTEX, SHAPE_FRAGMENT),
    shapeDepth: program(gl, SHAPE_VERTEX, DEPTH_FRAGMENT),
  };
  const size = Math.hypot(...minus(of.box[1], of.box[0])) / 2;
  const radius = Math.max(size, 1e-4);
  const boxMiddle = of.box[0].map((x, k) => (x + of.box[1][k]) / 2);
  const hairs = of.arrays.hairs.length / 11;
  const pieces = Math.max(1, Math.min(8, Math.ceil(48 / (of.points - 1))));

  const eachRows = Math.ceil(hairs / ROW), about = new Float32Array(eachRows * ROW * 4);
  for (let i = 0; i < hairs; i++) {
    const row = of.arrays.hairs.subarray(i * 11, i * 11 + 11), last = of.arrays.counts[row[0]] - 1;
    about.set([last, last * Math.max(1 - row[9], 0.05), row[10], 0], 4 * i);
  }
  const each = texture(gl, gl.NEAREST);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, ROW, eachRows);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, eachRows, gl.RGBA, gl.FLOAT, about);

  const shapes = [];
  for (let i = 0; `shape${i}_vertices` in of.arrays; i++) {
    const triangles = of.arrays[`shape${i}_triangles`];
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    buffer(gl, gl.ARRAY_BUFFER, smoothShape(of.arrays[`shape${i}_vertices`], triangles));
    buffer(gl, gl.ELEMENT_ARRAY_BUFFER, triangles);
    for (const k of [0, 1]) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
    }
    shapes.push({ array, count: triangles.length });
  }
  gl.bindVertexArray(null);

  const rows = Math.ceil((hairs * of.points) / ROW);
  if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("too many hairs");
  const grown = new Float32Array(rows * ROW * 4);
  const hairTexture = texture(gl, gl.NEAREST);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, ROW, rows);
  const shade = texture(gl, gl.NEAREST);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, MAP, MAP);
  const ramp = texture(gl, gl.LINEAR);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, 256, 1);
  const map = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, map);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, shade, 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.enable(gl.DEPTH_TEST);

  // The light stays with the hair: over the left shoulder of who looks first.
  const lamp = direction(of.view.azimuth - 0.75, Math.min(0.35 * of.view.elevation + 0.75, 1.4));
  const light = parallel(boxMiddle, lamp, radius);
  const width = radius / 320; // [m] of a hair, as drawn
  const least = of.strands / hairs;
  let frame = 0, field = null, placed = [], share = 1;

  // The first `part` of the hairs stand for all; they are drawn wider.
  function setShare(part) {
    share = Math.min(Math.max(part, least), 1);
    return share;
  }

  function setFrame(newFrame, newField, stops) {
    frame = newFrame;
    field = newField;
    placed = of.obstacles[frame];
    growHairs(of, frame, field, grown);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, hairTexture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, rows, gl.RGBA, gl.FLOAT, grown);
    gl.bindTexture(gl.TEXTURE_2D, ramp);
    if (stops) {
      const pixels = rampPixels(stops);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, map);
    gl.viewport(0, 0, MAP, MAP);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    const seen = { camera: light, eye: [...lamp, 0], pixel: (4 * radius) / MAP };
    all(programs.hairDepth, programs.shapeDepth, seen);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // From `eye` towards `target`, both [m].
  function draw(eye, target) {
    const [w, h] = [canvas.width, canvas.height];
    const distance = Math.hypot(...minus(eye, target));
    gl.viewport(0, 0, w, h);
    gl.clearColor(...BACKGROUND, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const near = Math.max(0.02 * radius, distance - 8 * radius), far = distance + 12 * radius;
    const camera = perspective(eye, target, w / h, near, far);
    all(programs.hair, programs.shape, {
      camera, eye: [...eye, 1], pixel: (2 * HALF_TAN) / h * Math.max(1, devicePixelRatio * 0.8),
    });
  }

  function all(hairProgram, shapeProgram, seen) {
    const about = field && of.fields[field];
    const uniforms = {
      ...seen, lamp, light, radius, width: width / share ** 0.5, background: BACKGROUND, color: of.color,
      middle: boxMiddle, hairs: 0, shade: 1, ramp: 2, each: 3, points: of.points, pieces,
      plain: !about, flatEdges: Boolean(about && about.edges),
    };
    // the map cannot be read while it is drawn
    const textures = [hairTexture, seen.eye[3] ? shade : null, ramp, each];
    textures.forEach((bound, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, bound);
    });
    shapeProgram.use(uniforms);
    for (const [shape, ...offset] of placed) {
      shapeProgram.use({ offset });
      gl.bindVertexArray(shapes[shape].array);
      gl.drawElements(gl.TRIANGLES, shapes[shape].count, gl.UNSIGNED_INT, 0);
    }
    hairProgram.use(uniforms);
    gl.bindVertexArray(null);
    const corners = 2 * ((of.points - 1) * pieces + 1) + 2;
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, corners * Math.ceil(hairs * share));
  }

  // Returns when all is drawn.
  function wait() {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const card = String(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  const slow = /swiftshader|llvmpipe|software|basic render/i.test(card);

  return { setShare, setFrame, draw, wait, radius, slow };
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`shader: ${logs.join(" ")} ${gl.getProgramInfoLog(made)}`);
  }
  const setters = {
    [gl.FLOAT]: (at, x) => gl.uniform1f(at, x),
    [gl.FLOAT_VEC3]: (at, x) => gl.uniform3fv(at, x),
    [gl.FLOAT_VEC4]: (at, x) => gl.uniform4fv(at, x),
    [gl.FLOAT_MAT4]: (at, x) => gl.uniformMatrix4fv(at, false, x),
  };
  const uniforms = {};
  const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) || 0;
  for (let i = 0; i < count; i++) {
    const { name, type } = gl.getActiveUniform(made, i);
    const at = gl.getUniformLocation(made, name);
    const set = setters[type] || ((place, x) => gl.uniform1i(place, x));
    uniforms[name] = (x) => set(at, x);
  }
  // Takes the program and sets those of the given uniforms that it has.
  function use(values) {
    gl.useProgram(made);
    for (const [name, value] of Object.entries(values)) if (uniforms[name]) uniforms[name](value);
  }
  return { use };
}

function buffer(gl, target, data) {
  gl.bindBuffer(target, gl.createBuffer());
  gl.bufferData(target, data, gl.STATIC_DRAW);
}

function texture(gl, filter) {
  const made = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, name, filter);
  }
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
    gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }
  return made;
}

// 256 colours between the stops, RGBA.
function rampPixels(stops) {
  const pixels = new Uint8Array(1024);
  for (let i = 0; i < 256; i++) {
    const x = (i / 255) * (stops.length - 1), k = Math.min(Math.floor(x), stops.length - 2);
    for (let c = 0; c < 3; c++) {
      pixels[4 * i + c] = Math.round(stops[k][c] + (x - k) * (stops[k + 1][c] - stops[k][c]));
    }
    pixels[4 * i + 3] = 255;
  }
  return pixels;
}

// Unit vector in the direction of two angles [rad].
const direction = (azimuth, elevation) => [
  Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth),
  Math.sin(elevation),
];

// Right, up and back of an eye that looks along -back; Z is up.
function axes(back) {
  const right = unit(Math.hypot(back[0], back[1]) < 1e-9 ? [0, 1, 0] : [-back[1], back[0], 0]);
  return [right, cross(back, right), back];
}

// Columns of the matrix whose rows are given, each a vector and a constant.
const columns = (rows) => [0, 1, 2, 3].flatMap((k) => rows.map((row) => row[k]));

function perspective(eye, target, aspect, near, far) {
  const [right, up, back] = axes(unit(minus(eye, target)));
  const [x, y, z] = [right, up, back].map((a) => [...a, -dot(a, eye)]);
  const depth = z.map((v) => (-v * (far + near)) / (far - near));
  depth[3] -= (2 * far * near) / (far - near);
  const scaled = (row, by) => row.map((v) => v * by);
  return columns([
    scaled(x, 1 / (HALF_TAN * aspect)), scaled(y, 1 / HALF_TAN), depth, scaled(z, -1),
  ]);
}

// Seen from the light, which is far away: a box of 4 radii about the middle.
function parallel(middle, lamp, radius) {
  const rows = axes(lamp).map((axis, k) => {
    const by = (k === 2 ? -1 : 1) / (2 * radius);
    return [...axis.map((v) => v * by), -dot(axis, middle) * by];
  });
  return columns([...rows, [0, 0, 0, 1]]);
}
