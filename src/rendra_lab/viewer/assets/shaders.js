// One program draws everything; attributes that an item lacks are constants.

const LOOKS = ["shaded", "colours only", "one colour", "normals", "height"];

const VERTEX_SHADER = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 color;
layout(location = 3) in vec2 uv;
uniform mat4 toClip;
uniform vec3 offset;
uniform float pointSize;
out vec3 place;
out vec3 bent;
out vec3 painted;
out vec2 texel;
void main() {
  place = position + offset;
  bent = normal;
  painted = color;
  texel = uv;
  gl_Position = toClip * vec4(place, 1.0);
  gl_PointSize = pointSize;
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;
in vec3 place;
in vec3 bent;
in vec3 painted;
in vec2 texel;
uniform vec3 eye;
uniform vec3 up;
uniform vec2 heights;
uniform vec4 plain;
uniform int look;      // rows of LOOKS
uniform int paint;     // 0: plain, 1: colours of vertices, 2: image
uniform int kind;      // 0: faces, 1: points, 2: lines
uniform bool flatFaces;
uniform bool depthOnly;
uniform sampler2D image;
out vec4 shown;

// Five colours of rising lightness.
vec3 ramp(float t) {
  const vec3 stops[5] = vec3[5](vec3(0.24, 0.08, 0.40), vec3(0.20, 0.33, 0.60), vec3(0.10, 0.57, 0.56),
                                vec3(0.42, 0.78, 0.36), vec3(0.98, 0.90, 0.24));
  float place = 4.0 * clamp(t, 0.0, 1.0);
  int below = min(int(place), 3);
  return mix(stops[below], stops[below + 1], place - float(below));
}

vec3 paper() {
  if (look == 2) return plain.rgb;
  if (look == 4) return ramp((dot(place, up) - heights.x) / max(heights.y - heights.x, 1e-12));
  return paint == 2 ? texture(image, texel).rgb : paint == 1 ? painted : plain.rgb;
}

void main() {
  vec2 disc = gl_PointCoord - 0.5;
  if (kind == 1 && dot(disc, disc) > 0.25) discard;
  if (depthOnly) {
    vec4 digits = fract(gl_FragCoord.z * vec4(1.0, 255.0, 65025.0, 16581375.0));
    shown = digits - digits.yzww * vec4(1.0 / 255.0, 1.0 / 255.0, 1.0 / 255.0, 0.0);
    return;
  }
  if (kind == 2) {
    shown = plain;
    return;
  }
  vec3 across = cross(dFdx(place), dFdy(place));
  bool known = dot(bent, bent) > 1e-6;
  vec3 n = bent;
  // the cross product faces the eye, as the front does
  if (kind == 0 && (flatFaces || !known)) n = gl_FrontFacing ? across : -across;
  n = n / max(length(n), 1e-30);
  vec3 color = paper();
  if (look == 3 && (kind == 0 || known)) color = 0.5 + 0.5 * n;
  if ((look == 0 || look == 2 || look == 4) && (kind == 0 || known)) {
    // a lamp at the eye lights both sides; a little more from above tells up from down
    float facing = dot(n, normalize(eye - place));
    float lamp = abs(facing);
    float sky = dot(n, up) * (facing < 0.0 ? -1.0 : 1.0);
    color = color * (0.44 + 0.52 * lamp + 0.08 * sky) + 0.08 * pow(lamp, 40.0);
  }
  shown = vec4(color, 1.0);
}`;

function builtProgram(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const why = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader)).join(" ");
    throw new Error("RendraViewer: " + gl.getProgramInfoLog(program) + " " + why);
  }
  const uniforms = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
  for (let i = 0; i < count; i++) {
    const name = gl.getActiveUniform(program, i).name;
    uniforms[name] = gl.getUniformLocation(program, name);
  }
  return { program: program, uniforms: uniforms };
}
