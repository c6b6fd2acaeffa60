// How a drawn image differs from a wanted one (FlyHuman Eq. 3), and its derivatives for the backward rasteriser.
// One invocation for four pixels of a column; sums in a fixed order.
// Prefix: const ROWS, LANES, SUMS, UNKNOWN.
struct Loss {
    // Pixels of the image.
    size: vec2<u32>,
    // First pixel of the area, and its pixels.
    first: vec2<u32>,
    area: vec2<u32>,
    // Where the sums of this image begin.
    sums_at: u32,
    color_weight: f32,
    mask_weight: f32,
    // Pixels of the wanted bytes in a row, and how many of them lie along the side of a pixel here.
    source_width: u32,
    shrink: u32,
    // Whether pixels that are UNKNOWN say nothing.
    with_unknown: u32,
}

struct Sums {
    loss: f32,
    // Squared difference of alpha.
    mask: f32,
    // Squared difference of colour where the person is wanted, and how much of the person is wanted there, pixels.
    color: f32,
    wanted: f32,
}

@group(0) @binding(0) var<storage, read> loss: Loss;
// sRGB and coverage, a byte each.
@group(0) @binding(1) var<storage, read> bytes: array<u32>;
// Linear value of each sRGB byte.
@group(0) @binding(2) var<storage, read> linear: array<f32>;
// Premultiplied linear colour and coverage; negative where nothing is known.
@group(0) @binding(3) var<storage, read_write> wanted: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> drawn: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> d_color: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> d_carry: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> partials: array<Sums>;
@group(0) @binding(8) var<storage, read_write> sums: array<Sums>;

// First pixel of an invocation's column; x beyond the image where there is none.
fn column(id: vec3<u32>) -> vec2<u32> {
    if id.x >= loss.area.x || id.y * ROWS >= loss.area.y {
        return vec2(0xffffffffu);
    }
    return loss.first + vec2(id.x, id.y * ROWS);
}

fn end_row() -> u32 {
    return loss.first.y + loss.area.y;
}

@compute @workgroup_size(LANES)
fn unpack_wanted(@builtin(global_invocation_id) id: vec3<u32>) {
    let first = column(id);
    if first.x == 0xffffffffu {
        return;
    }
    for (var y = first.y; y < min(first.y + ROWS, end_row()); y++) {
        var sum = vec4(0.0);
        var unknown = 0u;
        for (var v = 0u; v < loss.shrink; v++) {
            for (var u = 0u; u < loss.shrink; u++) {
                let word = bytes[(y * loss.shrink + v) * loss.source_width + first.x * loss.shrink + u];
                unknown += select(0u, 1u, word == UNKNOWN);
                let mask = f32(word >> 24u) / 255.0;
                sum += vec4(linear[word & 0xffu], linear[(word >> 8u) & 0xffu], linear[(word >> 16u) & 0xffu], 1.0)
                    * mask;
            }
        }
        if loss.with_unknown != 0u && 2u * unknown > loss.shrink * loss.shrink {
            sum = vec4(-1.0);
        }
        wanted[y * loss.size.x + first.x] = sum / f32(loss.shrink * loss.shrink);
    }
}

var<workgroup> lanes: array<Sums, LANES>;

fn both(a: Sums, b: Sums) -> Sums {
    return Sums(a.loss + b.loss, a.mask + b.mask, a.color + b.color, a.wanted + b.wanted);
}

@compute @workgroup_size(LANES)
fn compare(@builtin(global_invocation_id) id: vec3<u32>, @builtin(workgroup_id) group: vec3<u32>,
           @builtin(num_workgroups) groups: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let first = column(id);
    let weights = vec4(vec3(loss.color_weight), loss.mask_weight);
    let last = loss.first + loss.area - vec2(1u);
    var end = first.y;
    if first.x != 0xffffffffu {
        end = min(first.y + ROWS, end_row());
    }
    var sum = Sums(0.0, 0.0, 0.0, 0.0);
    for (var y = first.y; y < end; y++) {
        let at = y * loss.size.x + first.x;
        let goal = wanted[at];
        if goal.w < 0.0 {
            d_color[at] = vec4(0.0);
            d_carry[at] = vec4(0.0);
            continue;
        }
        let seen = drawn[at];
        let off = seen - goal;
        let squared = dot(off.rgb, off.rgb);
        sum.loss += loss.color_weight * squared + loss.mask_weight * off.w * off.w;
        sum.mask += off.w * off.w;
        sum.color += goal.w * squared;
        sum.wanted += goal.w;
        d_color[at] = 2.0 * weights * off;
        var bend = vec3(0.0);
        if first.x > loss.first.x && y > loss.first.y && first.x < last.x && y < last.y {
            let dx = 0.5 * (drawn[at + 1u] - drawn[at - 1u]);
            let dy = 0.5 * (drawn[at + loss.size.x] - drawn[at - loss.size.x]);
            let along = 2.0 * weights;
            bend = vec3(dot(along * dx, dx), dot(along * dx, dy), dot(along * dy, dy));
        }
        d_carry[at] = vec4(0.0, bend);
    }
    lanes[lane] = sum;
    for (var half = LANES / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            lanes[lane] = both(lanes[lane], lanes[lane + half]);
        }
    }
    if lane == 0u {
        partials[group.y * groups.x + group.x] = lanes[0];
    }
}

// SUMS invocations share the workgroups' sums, each an equal share in their order.
@compute @workgroup_size(SUMS)
fn add_up(@builtin(global_invocation_id) id: vec3<u32>) {
    let count = ((loss.area.x + LANES - 1u) / LANES) * ((loss.area.y + ROWS - 1u) / ROWS);
    let size = (count + SUMS - 1u) / SUMS;
    let begin = min(id.x * size, count);
    var sum = Sums(0.0, 0.0, 0.0, 0.0);
    for (var i = begin; i < min(begin + size, count); i++) {
        sum = both(sum, partials[i]);
    }
    sums[loss.sums_at + id.x] = sum;
}
