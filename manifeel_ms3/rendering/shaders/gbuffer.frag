#version 450
// Derived from the shader pack "minimal" of SAPIEN 3 (Copyright 2025 Hillbot Inc., 2020-2024 UCSD SU Lab; Apache License 2.0,
// see NOTICE); changed for manifeel_ms3.
// One pixel of a surface: light from the sky-like surroundings, directional lights of which the first casts a shadow, point and
// spot lights without shadows, and reflections of the room.
layout (constant_id = 0) const int NUM_DIRECTIONAL_LIGHTS = 0;
layout (constant_id = 1) const int NUM_DIRECTIONAL_LIGHT_SHADOWS = 0;
layout (constant_id = 2) const int NUM_POINT_LIGHTS = 0;
layout (constant_id = 3) const int NUM_POINT_LIGHT_SHADOWS = 0;
layout (constant_id = 4) const int NUM_SPOT_LIGHTS = 0;
layout (constant_id = 5) const int NUM_SPOT_LIGHT_SHADOWS = 0;
layout (constant_id = 6) const int NUM_TEXTURED_LIGHT_SHADOWS = 0;

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} cameraBuffer;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectDataBuffer;

layout(set = 2, binding = 0) uniform MaterialBuffer {
  vec4 emission;
  vec4 baseColor;
  float fresnel;
  float roughness;
  float metallic;
  float transmission;
  float ior;
  float transmissionRoughness;
  int textureMask;
  int padding1;
  vec4 textureTransforms[6];
} materialBuffer;

layout(set = 2, binding = 1) uniform sampler2D colorTexture;
layout(set = 2, binding = 2) uniform sampler2D roughnessTexture;
layout(set = 2, binding = 3) uniform sampler2D normalTexture;
layout(set = 2, binding = 4) uniform sampler2D metallicTexture;
layout(set = 2, binding = 5) uniform sampler2D emissionTexture;
layout(set = 2, binding = 6) uniform sampler2D transmissionTexture;

#define SET_NUM 3
#include "scene_set.glsl"
#include "room.glsl"
#include "tone.glsl"

layout(location = 0) in vec4 inPosition;
layout(location = 1) in vec2 inUV;
layout(location = 2) in flat uint inSegmentation;
layout(location = 3) in vec3 inNormal;
layout(location = 4) in vec3 inWorldPosition;

layout(location = 0) out vec4 outColorRaw;
layout(location = 1) out ivec4 outPositionSegmentation;

const float PI = 3.141592653589793;
const vec3 GROUND = vec3(0.52, 0.49, 0.46); // share of the ambient light that comes from below, by eye
const float NORMAL_BIAS = 1.5; // texels of the shadow map by which a surface is lifted before it is compared with it
const float SHADED_AMBIENT = 0.82; // share of the ambient light that is left in the shadow, by eye
const float DIELECTRIC = 0.04; // reflectance of plastics, wood and paint at normal incidence

struct Surface {
  vec3 normal;   // world
  vec3 toCamera; // world
  vec3 diffuse;
  vec3 specular; // reflectance at normal incidence
  float roughness;
};

// Light that a surface sends to the camera from a light in a direction: Lambert's law and a GGX lobe whose visibility and
// Fresnel terms are joined in one cheap factor, as real-time engines do on mobile devices. There the roughness in
// (4 roughness + 2) is squared; here it is not, which makes highlights of rough surfaces weaker.
vec3 lit(Surface surface, vec3 toLight, vec3 emission) {
  float cosine = dot(surface.normal, toLight);
  if (cosine <= 0) {
    return vec3(0);
  }
  vec3 middle = normalize(toLight + surface.toCamera);
  float alpha = surface.roughness * surface.roughness;
  float alpha2 = alpha * alpha;
  float along = clamp(dot(surface.normal, middle), 0, 1);
  float between = clamp(dot(toLight, middle), 0, 1);
  float d = along * along * (alpha2 - 1) + 1.00001;
  float lobe = alpha2 / (d * d * max(0.1, between * between) * (4 * surface.roughness + 2));
  return emission * cosine * (surface.diffuse + surface.specular * lobe) / PI;
}

// Share of a 3 x 3 neighbourhood of texels that the first light reaches, with bilinear weights: four gathers.
float lightReaches(vec3 normal, vec3 toLight) {
  LightBuffer light = shadowBuffer.directionalLightBuffers[0];
  float resolution = textureSize(samplerDirectionalLightDepths[0], 0).x;
  float texel = 2 / (light.projectionMatrix[0][0] * resolution); // m
  vec3 lifted = inWorldPosition + normal * (NORMAL_BIAS * texel * (1.1 - dot(normal, toLight)));
  vec3 at = (light.projectionMatrix * (light.viewMatrix * vec4(lifted, 1))).xyz;
  if (any(greaterThan(abs(at.xy), vec2(0.995)))) {
    return 1; // the map covers the bench alone
  }
  vec2 place = (at.xy * 0.5 + 0.5) * resolution - 0.5;
  vec2 part = fract(place);
  vec2 corner = (floor(place) + 1) / resolution; // common corner of the four texels around the place
  float total = 0;
  for (int k = 0; k < 4; ++k) {
    vec2 side = vec2((k & 1) == 0 ? -1 : 1, k < 2 ? -1 : 1);
    // (left below, right below, right above, left above), as a gather has them, and their weights
    vec4 open = step(vec4(at.z), textureGather(samplerDirectionalLightDepths[0], corner + side / resolution));
    vec2 x = side.x < 0 ? vec2(1 - part.x, 1) : vec2(1, part.x);
    vec2 y = side.y < 0 ? vec2(1 - part.y, 1) : vec2(1, part.y);
    total += dot(open, vec4(x.x * y.y, x.y * y.y, x.y * y.x, x.x * y.x));
  }
  return total / 9;
}

void main() {
  vec4 albedo = materialBuffer.baseColor;
  if ((materialBuffer.textureMask & 1) != 0) {
    albedo *= texture(colorTexture, inUV * materialBuffer.textureTransforms[0].zw + materialBuffer.textureTransforms[0].xy);
  }
  albedo.a *= 1 - objectDataBuffer.transparency;
  if (albedo.a == 0) {
    discard;
  }
  float metallic = materialBuffer.metallic;
  Surface surface;
  surface.toCamera = normalize(cameraBuffer.viewMatrixInverse[3].xyz - inWorldPosition);
  surface.normal = normalize(objectDataBuffer.shadeFlat == 0 ? inNormal : cross(dFdy(inWorldPosition), dFdx(inWorldPosition)));
  surface.diffuse = albedo.rgb * (1 - metallic);
  surface.specular = mix(vec3(DIELECTRIC), albedo.rgb, metallic);
  surface.roughness = clamp(materialBuffer.roughness, 0.1, 1);

  vec3 color = materialBuffer.emission.rgb;
  float reached = 1;
  for (int i = 0; i < NUM_DIRECTIONAL_LIGHTS; ++i) {
    vec3 toLight = -sceneBuffer.directionalLights[i].direction.xyz;
    vec3 light = lit(surface, toLight, sceneBuffer.directionalLights[i].emission.rgb);
    if (i == 0 && NUM_DIRECTIONAL_LIGHT_SHADOWS > 0) {
      reached = dot(surface.normal, toLight) > 0 ? lightReaches(surface.normal, toLight) : 0;
      light *= reached;
    }
    color += light;
  }
  for (int i = 0; i < NUM_POINT_LIGHTS; ++i) {
    vec3 l = sceneBuffer.pointLights[i].position.xyz - inWorldPosition;
    float square = max(dot(l, l), 1e-6);
    color += lit(surface, l * inversesqrt(square), sceneBuffer.pointLights[i].emission.rgb / square);
  }
  for (int i = 0; i < NUM_SPOT_LIGHTS; ++i) {
    vec3 l = sceneBuffer.spotLights[i].position.xyz - inWorldPosition;
    float square = max(dot(l, l), 1e-6);
    vec3 toLight = l * inversesqrt(square);
    float inner = cos(sceneBuffer.spotLights[i].emission.a / 2) + 1e-6;
    float outer = cos(sceneBuffer.spotLights[i].direction.a / 2);
    float inside = clamp((dot(-toLight, sceneBuffer.spotLights[i].direction.xyz) - outer) / (inner - outer), 0, 1);
    color += inside * lit(surface, toLight, sceneBuffer.spotLights[i].emission.rgb / square);
  }

  vec3 ambient = sceneBuffer.ambientLight.rgb * mix(SHADED_AMBIENT, 1, reached);
  color += ambient * surface.diffuse * mix(GROUND, vec3(1), 0.5 + 0.5 * surface.normal.z);
  // reflections, with Karis' fit of the GGX lobe's integral ("Physically Based Shading on Mobile", 2014)
  float facing = clamp(dot(surface.normal, surface.toCamera), 0, 1);
  vec4 r = surface.roughness * vec4(-1, -0.0275, -0.572, 0.022) + vec4(1, 0.0425, 1.04, -0.04);
  float a = min(r.x * r.x, exp2(-9.28 * facing)) * r.x + r.y;
  vec3 mirrored = reflect(-surface.toCamera, surface.normal);
  color += ambient * reflected(mirrored, surface.roughness) * (surface.specular * (r.z - 1.04 * a) + (r.w + 1.04 * a));

  outColorRaw = vec4(toned(color) * albedo.a, albedo.a);
  outPositionSegmentation = ivec4(ivec3(inPosition * 1000), inSegmentation);
}
