// Derived from the shader pack "minimal" of SAPIEN 3 (Copyright 2025 Hillbot Inc., 2020-2024 UCSD SU Lab; Apache License 2.0,
// see NOTICE); changed for manifeel_ms3.
// The scene's lights and their shadows, as SAPIEN lays them out. Define SET_NUM before.
struct PointLight {
  vec4 position;
  vec4 emission;
};

struct DirectionalLight {
  vec4 direction;
  vec4 emission;
};

struct SpotLight {
  vec4 position;
  vec4 direction;
  vec4 emission;
};

layout(set = SET_NUM, binding = 0) uniform SceneBuffer {
  vec4 ambientLight;
  PointLight pointLights[10];
  DirectionalLight directionalLights[3];
  SpotLight spotLights[10];
  SpotLight texturedLights[1];
} sceneBuffer;

struct LightBuffer {
  mat4 viewMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrix;
  mat4 projectionMatrixInverse;
  int width;
  int height;
};

layout(set = SET_NUM, binding = 1) uniform ShadowBuffer {
  LightBuffer pointLightBuffers[60];
  LightBuffer directionalLightBuffers[3];
  LightBuffer spotLightBuffers[10];
  LightBuffer texturedLightBuffers[1];
} shadowBuffer;

layout(set = SET_NUM, binding = 2) uniform samplerCube samplerPointLightDepths[10];
layout(set = SET_NUM, binding = 3) uniform sampler2D samplerDirectionalLightDepths[3];
layout(set = SET_NUM, binding = 4) uniform sampler2D samplerSpotLightDepths[10];
layout(set = SET_NUM, binding = 5) uniform sampler2D samplerTexturedLightDepths[1];
layout(set = SET_NUM, binding = 6) uniform sampler2D samplerTexturedLightTextures[1];
layout(set = SET_NUM, binding = 7) uniform samplerCube samplerEnvironment;
// Binding 8, samplerBRDFLUT, is left out: where it is declared, SAPIEN first computes its table, for 10 s on a CPU.
