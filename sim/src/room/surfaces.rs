//! Textures of rooms and furniture.

use glam::{Vec2, Vec3};

use crate::clothes::wardrobe::SrgbColor;
use crate::noise::{Noise, smoothstep};
use crate::texture::{TextureImage, mix3, scale3};

/// Texture and its index in the array of textures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub(crate) enum Surface {
    /// Paint, plastic, metal.
    Plain,
    /// Floor of planks.
    Planks,
    Plaster,
    Carpet,
    /// Grain along u.
    Wood,
    Weave,
    Card,
    Concrete,
    Leaf,
    Rug,
    /// Image that fills its object.
    PosterA,
    PosterB,
    PosterC,
    PosterD,
    ScreenA,
    ScreenB,
    /// View through a window.
    Outside,
}

impl Surface {
    pub(crate) const ALL: [Self; 17] = [
        Self::Plain,
        Self::Planks,
        Self::Plaster,
        Self::Carpet,
        Self::Wood,
        Self::Weave,
        Self::Card,
        Self::Concrete,
        Self::Leaf,
        Self::Rug,
        Self::PosterA,
        Self::PosterB,
        Self::PosterC,
        Self::PosterD,
        Self::ScreenA,
        Self::ScreenB,
        Self::Outside,
    ];

    /// Returns the repetitions per metre; `None` for images that fill their object.
    pub(crate) fn repeats_a_metre(self) -> Option<f32> {
        match self {
            Self::Plain | Self::Plaster => Some(0.7),
            Self::Planks => Some(1.0 / 2.56),
            Self::Carpet | Self::Concrete => Some(0.6),
            Self::Wood => Some(0.9),
            Self::Weave => Some(4.0),
            Self::Card => Some(1.2),
            _ => None,
        }
    }

    /// Paints the texture, `side` pixels wide.
    pub(crate) fn texture(self, side: usize, seed: u64) -> TextureImage {
        let noise = Noise::new(seed, 60 + self as u32);
        TextureImage::from_fn(side, |uv| match self {
            Self::Plain => grey(0.985 + 0.015 * tiled(noise, uv, 9, 2)),
            Self::Planks => planks(noise, uv),
            Self::Plaster => grey(0.955 + 0.03 * tiled(noise, uv, 5, 3) + 0.012 * tiled(noise, uv, 90, 1)),
            Self::Carpet => grey(0.80 + 0.12 * tiled(noise, uv, 160, 1) + 0.05 * tiled(noise, uv, 6, 3)),
            Self::Wood => wood(noise, uv, 1.0),
            Self::Weave => weave(noise, uv),
            Self::Card => {
                let flute = 0.012 * (uv.y * 60.0 * std::f32::consts::TAU).sin();
                scale3([0.72, 0.55, 0.37], 0.97 + flute + 0.05 * tiled(noise, uv, 12, 3))
            }
            Self::Concrete => grey(0.80 + 0.09 * tiled(noise, uv, 4, 5) + 0.03 * tiled(noise, uv, 70, 1)),
            Self::Leaf => {
                let vein = smoothstep(0.05, 0.0, (uv.x - 0.5).abs());
                let ribs = 0.06 * ((uv.y * 9.0 + (uv.x - 0.5).abs() * 5.0) * std::f32::consts::TAU).sin();
                mix3(scale3([0.24, 0.44, 0.19], 1.0 + ribs + 0.2 * uv.y), [0.50, 0.62, 0.34], 0.6 * vein)
            }
            Self::Rug => rug(noise, uv),
            Self::PosterA => landscape(noise, uv),
            Self::PosterB => shapes(noise, uv),
            Self::PosterC => print_with_text(noise, uv),
            Self::PosterD => waves(noise, uv),
            Self::ScreenA => editor(noise, uv),
            Self::ScreenB => charts(noise, uv),
            Self::Outside => outside(noise, uv),
        })
    }
}

fn grey(value: f32) -> SrgbColor {
    [value; 3]
}

/// Returns noise of `cells` per side that is periodic at the edges, in -1..=1.
fn tiled(noise: Noise, uv: Vec2, cells: i32, octaves: u32) -> f32 {
    let (mut sum, mut weight, mut height, mut cells) = (0.0, 0.0, 1.0, cells);
    for octave in 0..octaves {
        let p = uv * cells as f32;
        let low = p.floor();
        let t = p - low;
        let t = t * t * (Vec2::splat(3.0) - 2.0 * t);
        let at = |dx: i32, dy: i32| {
            let wrap = |c: f32, d: i32| (c as i32 + d).rem_euclid(cells);
            noise.cell(wrap(low.x, dx), wrap(low.y, dy), octave as i32)
        };
        let row = |dy| at(0, dy) + (at(1, dy) - at(0, dy)) * t.x;
        sum += height * (row(0) + (row(1) - row(0)) * t.y);
        weight += height;
        height *= 0.5;
        cells *= 2;
    }
    sum / weight
}

fn wood(noise: Noise, uv: Vec2, contrast: f32) -> SrgbColor {
    let warp = 0.05 * tiled(noise, Vec2::new(uv.x, uv.y), 3, 2);
    let rings = ((uv.y + warp) * 14.0 * std::f32::consts::TAU).sin() * 0.5 + 0.5;
    let fibre = tiled(noise, Vec2::new(uv.x, uv.y), 4, 1) * 0.3 + stretched(noise, uv, 120) * 0.7;
    let tone = 0.92 + contrast * (0.08 * rings + 0.07 * fibre);
    scale3([0.86, 0.74, 0.58], tone)
}

/// Returns fine streaks along u.
fn stretched(noise: Noise, uv: Vec2, rows: i32) -> f32 {
    let y = uv.y * rows as f32;
    let (low, x) = (y.floor(), uv.x * 6.0);
    let at = |row: f32| {
        let row = (row as i32).rem_euclid(rows);
        let column = |c: f32| noise.cell((c as i32).rem_euclid(6), row, 77);
        let t = x - x.floor();
        column(x.floor()) * (1.0 - t) + column(x.floor() + 1.0) * t
    };
    let t = y - low;
    at(low) * (1.0 - t) + at(low + 1.0) * t
}

fn planks(noise: Noise, uv: Vec2) -> SrgbColor {
    const ROWS: f32 = 16.0;
    const EACH: f32 = 2.0;
    let row = (uv.y * ROWS).floor();
    let shifted = uv.x * EACH + 0.37 * row;
    let plank = shifted.floor();
    let index = (plank as i32).rem_euclid(EACH as i32);
    let tone = noise.cell(row as i32, index, 7);
    let local = Vec2::new(uv.x + 0.31 * tone, uv.y * 4.0 + 0.17 * row + tone);
    let grain = stretched(noise, local, 90) * 0.6 + tiled(noise, local, 8, 2) * 0.4;
    let wood = mix3([0.60, 0.47, 0.34], [0.72, 0.59, 0.44], 0.5 + 0.5 * tone);
    // Gaps of a few millimetres of 2.56 m.
    let across = 0.5 - (uv.y * ROWS - row - 0.5).abs();
    let along = 0.5 - (shifted - plank - 0.5).abs();
    let gap = smoothstep(0.018, 0.004, across).max(smoothstep(0.0022, 0.0006, along));
    scale3(wood, (1.0 + 0.10 * grain) * (1.0 - 0.5 * gap))
}

fn weave(noise: Noise, uv: Vec2) -> SrgbColor {
    let p = uv * 24.0;
    let over = ((p.x.floor() + p.y.floor()) as i32).rem_euclid(2) == 0;
    let t = p - p.floor() - 0.5;
    let bump = if over { 1.0 - 1.4 * t.y * t.y } else { 0.93 - 1.4 * t.x * t.x };
    grey((0.86 + 0.04 * tiled(noise, uv, 12, 2)) * bump + 0.04)
}

fn rug(noise: Noise, uv: Vec2) -> SrgbColor {
    let edge = uv.min(Vec2::ONE - uv);
    let from_edge = edge.min_element();
    let field = [0.50, 0.17, 0.16];
    let (ink, cream) = ([0.16, 0.19, 0.33], [0.84, 0.76, 0.60]);
    let mirrored = (uv - 0.5).abs();
    let diamond = mirrored.x * 1.3 + mirrored.y;
    let knots = (mirrored * 40.0).floor();
    let dots = ((knots.x + knots.y) as i32).rem_euclid(4) == 0;
    let mut colour = match () {
        () if from_edge < 0.02 => cream,
        () if from_edge < 0.10 => {
            let along = if edge.x < edge.y { uv.y } else { uv.x };
            let step = ((along * 28.0).fract() - 0.5).abs() * 2.0;
            if (from_edge - 0.06).abs() < 0.03 * (1.0 - step) { cream } else { ink }
        }
        () if from_edge < 0.115 => cream,
        () if diamond < 0.12 => ink,
        () if diamond < 0.14 => cream,
        () if diamond < 0.27 => mix3(field, [0.70, 0.36, 0.22], 0.6),
        () if diamond < 0.285 => ink,
        () if dots => mix3(field, cream, 0.5),
        () => field,
    };
    colour = scale3(colour, 0.92 + 0.10 * tiled(noise, uv, 120, 2));
    colour
}

fn landscape(noise: Noise, uv: Vec2) -> SrgbColor {
    let ridge = |base: f32, height: f32, seed: f32| base + height * noise.sum(Vec3::new(uv.x * 3.2, seed, 1.0), 5);
    let sky = mix3([0.98, 0.80, 0.62], [0.42, 0.58, 0.75], smoothstep(0.65, 0.0, uv.y));
    let sun = smoothstep(0.085, 0.08, uv.distance(Vec2::new(0.66, 0.36)));
    let mut colour = mix3(sky, [1.0, 0.93, 0.80], sun);
    for (base, height, seed, paint) in [
        (0.52, 0.16, 1.0, [0.55, 0.58, 0.68]),
        (0.66, 0.14, 5.0, [0.36, 0.42, 0.50]),
        (0.82, 0.10, 9.0, [0.16, 0.24, 0.24]),
    ] {
        let below = smoothstep(-0.004, 0.004, uv.y - ridge(base, height, seed));
        colour = mix3(colour, paint, below);
    }
    framed(colour, uv, 0.05)
}

fn outside(noise: Noise, uv: Vec2) -> SrgbColor {
    let cloud = smoothstep(0.0, 0.6, noise.sum(Vec3::new(uv.x * 3.0, uv.y * 6.0, 2.0), 4));
    let mut colour = mix3(mix3([0.62, 0.76, 0.92], [0.86, 0.91, 0.95], uv.y), [0.97, 0.97, 0.96], cloud);
    // Roofs, then the tops of trees before them.
    let house = (uv.x * 5.0).floor();
    let roof = 0.60 + 0.06 * noise.cell(house as i32, 1, 1) + 0.10 * ((uv.x * 5.0).fract() - 0.5).abs();
    if uv.y > roof {
        let brick = mix3([0.66, 0.56, 0.50], [0.56, 0.50, 0.48], 0.5 + 0.5 * noise.cell(house as i32, 2, 1));
        let pane = ((uv.x * 30.0).fract() - 0.5).abs() < 0.2 && ((uv.y * 16.0).fract() - 0.5).abs() < 0.25;
        colour = if uv.y < roof + 0.05 {
            [0.50, 0.36, 0.32]
        } else if pane {
            [0.42, 0.47, 0.52]
        } else {
            brick
        };
    }
    let tree = 0.80 + 0.12 * noise.sum(Vec3::new(uv.x * 5.0, 7.0, 3.0), 4);
    if uv.y > tree {
        colour = mix3(
            [0.33, 0.44, 0.27],
            [0.22, 0.32, 0.18],
            0.5 + 0.5 * noise.sum(Vec3::new(uv.x * 30.0, uv.y * 30.0, 1.0), 3),
        );
    }
    colour
}

fn framed(colour: SrgbColor, uv: Vec2, margin: f32) -> SrgbColor {
    if uv.min(Vec2::ONE - uv).min_element() < margin { [0.93, 0.92, 0.88] } else { colour }
}

fn shapes(noise: Noise, uv: Vec2) -> SrgbColor {
    let paints = [[0.86, 0.24, 0.18], [0.95, 0.74, 0.20], [0.13, 0.29, 0.52], [0.12, 0.12, 0.13]];
    let mut colour = [0.93, 0.89, 0.80];
    for k in 0..7 {
        let at = Vec2::new(noise.cell(k, 0, 1), noise.cell(k, 1, 1)) * 0.34 + 0.5;
        let size = 0.06 + 0.14 * (0.5 + 0.5 * noise.cell(k, 2, 1));
        let turn = Vec2::from_angle(noise.cell(k, 3, 1) * 1.6).rotate(uv - at);
        let inside = match k % 3 {
            0 => turn.length() - size,
            1 => (turn.abs() - Vec2::new(size * 1.6, size * 0.28)).max_element(),
            _ => (turn.length() - size).abs().max(turn.y) - size * 0.22,
        };
        colour = mix3(colour, paints[k as usize % 4], smoothstep(0.002, -0.002, inside));
    }
    colour
}

fn print_with_text(noise: Noise, uv: Vec2) -> SrgbColor {
    let (paper, ink) = ([0.90, 0.88, 0.82], [0.12, 0.13, 0.16]);
    let mut colour = paper;
    if (0.10..0.55).contains(&uv.y) && (0.12..0.88).contains(&uv.x) {
        let p = Vec2::new((uv.x - 0.5) / 0.38, (uv.y - 0.33) / 0.23);
        let arc = (p * Vec2::new(1.0, 0.7)).length();
        colour = mix3([0.10, 0.36, 0.40], [0.94, 0.56, 0.33], smoothstep(0.2, 1.0, arc));
        colour = mix3(colour, paper, smoothstep(0.05, 0.0, ((arc * 9.0).fract() - 0.5).abs()));
    }
    // A headline and lines of small print.
    let headline = (0.62..0.70).contains(&uv.y) && (0.12..0.80).contains(&uv.x);
    let letter = noise.cell((uv.x * 34.0) as i32, ((uv.y - 0.62) * 40.0) as i32, 3) > -0.35;
    if headline && letter && (uv.x * 8.5).fract() > 0.12 {
        colour = ink;
    }
    let line = ((uv.y - 0.75) * 40.0).floor();
    let on_line = (0.75..0.92).contains(&uv.y) && ((uv.y - 0.75) * 40.0).fract() < 0.45;
    if on_line && uv.x > 0.12 && uv.x < 0.85 - 0.2 * (0.5 + 0.5 * noise.cell(line as i32, 5, 5)) {
        let word = noise.cell((uv.x * 60.0) as i32, line as i32, 4) > -0.5;
        if word {
            colour = mix3(paper, ink, 0.7);
        }
    }
    colour
}

fn waves(noise: Noise, uv: Vec2) -> SrgbColor {
    let warp = noise.sum(Vec3::new(uv.x * 2.5, uv.y * 2.5, 3.0), 4);
    let band = ((uv.y * 5.0 + 1.6 * warp).fract() - 0.5).abs() * 2.0;
    let tone = mix3([0.09, 0.20, 0.34], [0.80, 0.86, 0.84], band);
    framed(mix3(tone, [0.90, 0.52, 0.34], smoothstep(0.35, 0.5, warp)), uv, 0.04)
}

fn editor(noise: Noise, uv: Vec2) -> SrgbColor {
    let back = [0.11, 0.12, 0.16];
    if uv.y < 0.05 {
        return [0.20, 0.21, 0.26];
    }
    if uv.x < 0.16 {
        let line = (uv.y * 32.0).fract();
        let row = (uv.y * 32.0) as i32;
        let wide = 0.03 + 0.05 * (1.0 + noise.cell(row, 3, 8));
        return if (0.35..0.65).contains(&line) && uv.x > 0.02 && uv.x < wide {
            [0.45, 0.47, 0.52]
        } else {
            [0.15, 0.16, 0.20]
        };
    }
    let row = (uv.y * 38.0) as i32;
    let line = (uv.y * 38.0).fract();
    let indent = 0.19 + 0.03 * (1.5 + 1.5 * noise.cell(row / 3, 1, 8)).floor();
    let end = indent + 0.12 + 0.26 * (1.0 + noise.cell(row, 2, 8));
    let blank = noise.cell(row, 9, 8) < -0.75;
    if blank || !(0.3..0.7).contains(&line) || uv.x < indent || uv.x > end {
        return back;
    }
    let word = (uv.x * 42.0) as i32;
    if noise.cell(word, row, 8) < -0.6 {
        return back;
    }
    let inks = [[0.56, 0.75, 0.90], [0.80, 0.80, 0.78], [0.90, 0.66, 0.45], [0.62, 0.80, 0.52]];
    inks[((noise.cell(word / 3, row, 6) * 0.5 + 0.5) * 3.99) as usize]
}

fn charts(noise: Noise, uv: Vec2) -> SrgbColor {
    let back = [0.94, 0.95, 0.96];
    if uv.y < 0.07 {
        return [0.23, 0.42, 0.62];
    }
    let (card, local) = ((uv * 2.0).floor(), (uv * Vec2::new(2.0, 2.0)).fract());
    if !(0.08..0.92).contains(&local.x) || !(0.16..0.90).contains(&local.y) {
        return back;
    }
    let q = Vec2::new((local.x - 0.08) / 0.84, 1.0 - (local.y - 0.16) / 0.74);
    let kind = (card.x + 2.0 * card.y) as i32;
    let ink =
        [[0.25, 0.52, 0.72], [0.88, 0.50, 0.26], [0.35, 0.62, 0.42], [0.62, 0.36, 0.55]][kind.clamp(0, 3) as usize];
    if kind % 2 == 0 {
        let bar = (q.x * 9.0).floor();
        let height = 0.25 + 0.6 * (0.5 + 0.5 * noise.cell(bar as i32, kind, 4));
        return if (q.x * 9.0).fract() < 0.7 && q.y < height { ink } else { [1.0; 3] };
    }
    let curve = 0.5 + 0.3 * noise.sum(Vec3::new(q.x * 5.0, kind as f32, 2.0), 3);
    if (q.y - curve).abs() < 0.02 {
        ink
    } else if q.y < curve {
        mix3([1.0; 3], ink, 0.25)
    } else {
        [1.0; 3]
    }
}
