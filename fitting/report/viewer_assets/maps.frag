// What maps show under a distant light, or one of them. Before this text stand the material (brdf_light), whose numbers
// are globals that are set here for each texel, and display.frag.
uniform highp usampler2D surface;  // normal, folded onto a square; log2 n; reason and model: 16 bits each
uniform sampler2D diffuse, specular;  // k_d and the residual, k_s and the error of ln n
uniform vec2 size, range;
uniform vec3 to_light, to_view, palette[REASONS];
uniform int map, model;
const int RELIT = 0, K_D = 1, K_S = 2, N = 3, NORMAL = 4, DETERMINED = 5, ERROR = 6, RESIDUAL = 7;

vec3 unfolded(vec2 square) {  // octahedral: Cigolle et al. 2014
    vec3 v = vec3(square, 1.0 - abs(square.x) - abs(square.y));
    if (v.z < 0.0) v.xy = (1.0 - abs(v.yx)) * mix(vec2(-1.0), vec2(1.0), greaterThanEqual(v.xy, vec2(0.0)));
    return normalize(v);
}

void main() {
    vec2 place = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
    uvec4 here = texelFetch(surface, ivec2(place), 0);
    int reason = int(here.w & 7u);
    if (reason == OUTSIDE || int(here.w >> 3) != model) discard;
    vec4 k_d = texelFetch(diffuse, ivec2(place), 0), k_s = texelFetch(specular, ivec2(place), 0);
    vec3 normal = unfolded((vec2(here.xy) - 32767.0) / 32767.0);
    float log2_n = float(here.z) * OCTAVES / 65535.0;
    BRDF_K_D = k_d.rgb, BRDF_K_S = k_s.rgb, BRDF_N = exp2(log2_n), BRDF_SCALE = brdf_scale(BRDF_N);
    float number = map == N ? log2_n : map == ERROR ? k_s.a : k_d.a;
    vec3 ramped = number < 0.0 ? vec3(0.16) : ramp(2.0 * (number - range.x) / (range.y - range.x) - 1.0);
    if (map == NORMAL) colour = rounded(0.5 * normal + 0.5);
    else if (map == DETERMINED) colour = rounded(palette[reason]);
    else if (map >= N) colour = rounded(ramped);
    else {
        vec3 shown = map == RELIT ? brdf_light(normal, to_light, to_view, vec3(1.0)) : map == K_D ? k_d.rgb : k_s.rgb;
        colour = rounded(display(shown, place));
    }
}
