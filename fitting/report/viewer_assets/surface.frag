// What a pixel sees and shows. Before this text stand the material (brdf_ambient, brdf_light) with its numbers as
// uniforms, and display.frag. Lengths are in units of the scene's size and the pivot is the origin: single precision then
// is enough.
uniform vec2 size, middle, corner_of_probe;
uniform float pitch, depth_of_pivot, unit;
uniform bool perspective, local_viewer;
uniform vec3 axis_point, right, up, forward, eye;
uniform int spheres, rectangles, lights;
uniform vec4 sphere[SPHERES];  // centre and radius
uniform bool sphere_fitted[SPHERES], rectangle_fitted[RECTANGLES];
uniform vec3 rectangle[3 * RECTANGLES];  // centre, edge_u, edge_v
uniform vec3 ambient, light_place[LIGHTS], light_intensity[LIGHTS], light_attenuation[LIGHTS], light_axis[LIGHTS];
uniform vec3 light_kind[LIGHTS];  // 0 directional, 1 point, 2 spot; cosine of the cutoff; exponent
uniform bool mesh_fitted;

struct Hit {
    float along;  // from the plane through the pivot
    vec3 position, normal;
    bool fitted;
};

vec3 radiance(vec3 position, vec3 normal, vec3 to_view) {
    vec3 total = brdf_ambient(ambient);
    for (int i = 0; i < lights; i++) {
        vec3 to_light = light_place[i], intensity = light_intensity[i];
        if (light_kind[i].x > 0.5) {
            vec3 offset = to_light - position;
            float apart = length(offset) * unit;
            to_light = normalize(offset);
            intensity /= dot(light_attenuation[i], vec3(1.0, apart, apart * apart));
        }
        if (light_kind[i].x > 1.5) {
            float aligned = -dot(to_light, light_axis[i]);
            bool inside = light_kind[i].y <= -1.0 || aligned >= light_kind[i].y;
            intensity *= inside ? (light_kind[i].z > 0.0 ? pow(max(aligned, 0.0), light_kind[i].z) : 1.0) : 0.0;
        }
        total += brdf_light(normal, to_light, to_view, intensity);
    }
    return total;
}

// -- what is shown ----------------------------------------------------------------------------------------------------

#ifdef PROBE
layout(location = 0) out uvec4 probed_value;
layout(location = 1) out uvec4 probed_normal;
layout(location = 2) out uvec4 probed_position;
#else
uniform sampler2D target, still;
uniform bool compared, from_still;
uniform vec2 wipe;  // columns: target before the first, residual beyond the second
uniform float residual_limit;
#endif

void show(vec3 value, bool fitted, vec3 position, vec3 normal, vec2 place) {
#ifdef PROBE
    probed_value = floatBitsToUint(vec4(value, 1.0));
    probed_normal = floatBitsToUint(vec4(normal, fitted ? 1.0 : 0.0));
    probed_position = floatBitsToUint(vec4(position, 1.0));
#else
    if (compared) {
        vec4 seen = texelFetch(target, ivec2(place), 0);
        if (from_still) value = texelFetch(still, ivec2(place), 0).rgb;
        if (place.x > wipe.y) {
            colour = vec4(seen.a > 0.5 ? ramp(largest(value - seen.rgb) / residual_limit) : vec3(0.16), 1.0);
            return;
        }
        if (place.x < wipe.x) value = seen.rgb;
    }
    colour = rounded(display(value, place));
#endif
}

// -- what is hit ------------------------------------------------------------------------------------------------------

vec3 towards_eye(vec3 position) {
    return local_viewer ? normalize(eye - position) : -forward;
}

void nearer(inout Hit best, float along, float start, vec3 position, vec3 normal, bool fitted) {
    if (along > start && along < best.along) best = Hit(along, position, normal, fitted);
}

#ifdef MESH
flat in vec3 a, b, c, of_a, of_b, of_c;
#endif

void main() {
    vec2 place = gl_FragCoord.xy + corner_of_probe;
    place.y = size.y - place.y;
    vec2 xy = middle + pitch * (place - 0.5 * size) * vec2(1.0, -1.0);
    if (perspective) xy *= depth_of_pivot;
    vec3 start = axis_point + xy.x * right + xy.y * up;  // on the plane through the pivot, where numbers are small
    vec3 ray = perspective ? normalize(start - eye) : forward;
    float first = perspective ? -distance(start, eye) : -depth_of_pivot;
    const float FAR = 1e4;
    Hit best = Hit(FAR, vec3(0.0), vec3(0.0, 0.0, 1.0), false);
#ifdef MESH
    vec3 area = cross(b - a, c - a);
    float slope = dot(ray, area), along = dot(a - start, area) / slope;
    vec3 depths = vec3(dot(a - start, ray), dot(b - start, ray), dot(c - start, ray));  // seen edge-on, a plane says little
    along = clamp(along, min(depths.x, min(depths.y, depths.z)), max(depths.x, max(depths.y, depths.z)));
    vec3 position = start + along * ray;
    float second = dot(cross(position - a, c - a), area) / dot(area, area);
    float third = dot(cross(b - a, position - a), area) / dot(area, area);
    vec3 shading = (1.0 - second - third) * of_a + second * of_b + third * of_c;
    best = Hit(along, position, normalize(slope < 0.0 ? shading : area), mesh_fitted);
#else
    for (int i = 0; i < spheres; i++) {
        vec3 to_start = start - sphere[i].xyz;
        float along = dot(to_start, ray);
        vec3 nearest = to_start - along * ray;
        float squared = sphere[i].w * sphere[i].w - dot(nearest, nearest);
        if (squared <= 0.0) continue;
        float half_chord = sqrt(squared);
        float which = -along - half_chord > first ? -half_chord : half_chord;
        vec3 normal = normalize(nearest + which * ray);
        nearer(best, which - along, first, sphere[i].xyz + sphere[i].w * normal, normal, sphere_fitted[i]);
    }
    for (int i = 0; i < rectangles; i++) {
        vec3 u = rectangle[3 * i + 1], v = rectangle[3 * i + 2], area = cross(u, v), to_centre = rectangle[3 * i] - start;
        float slope = dot(ray, area);
        if (slope == 0.0) continue;
        float along = dot(to_centre, area) / slope;
        vec3 position = start + along * ray, offset = position - rectangle[3 * i];
        vec2 inside = vec2(dot(cross(offset, v), area), dot(cross(u, offset), area)) / dot(area, area);
        if (all(lessThanEqual(abs(inside), vec2(1.0))))
            nearer(best, along, first, position, normalize(area), rectangle_fitted[i]);
    }
#endif
    bool seen = best.along < FAR;
    gl_FragDepth = seen ? clamp(0.5 + 0.4 * best.along / (1.0 + abs(best.along)), 0.0, 0.99) : 1.0;
    vec3 value = vec3(0.0);
    if (seen && best.fitted) value = radiance(best.position, best.normal, towards_eye(best.position));
    show(value, seen && best.fitted, best.position, best.normal, place);
}
