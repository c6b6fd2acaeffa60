//! Skirts and coats as shells around the legs.
//!
//! Points of a skirt show one side of a sheet. Their fusion closes the skirt at the hem, far from any true surface. [`Hollow`] is the space
//! that is empty all the same: inside the skirt, at a depth that the voxels can represent, up to the crotch, outside of the legs that the
//! skirt hides. It is cut out of the field, and [`Hollow::thin`] brings the wall that remains to its true thickness.

mod signed;
mod stand_in;
mod thin;

use std::collections::HashSet;

use flyrig_avatar::{Attachment, Avatar};
use flyrig_body::{Part, Template};
use glam::{Vec2, Vec3};

use crate::OrientedPoint;
use crate::density::median;

use signed::{Signed, SignedPoints, SignedSurface};
pub(super) use stand_in::StandIns;

/// Thickness of the wall that is cut, and width of the gap that is kept between wall and legs, in voxels.
const WALL_VOXELS: f32 = 2.0;
const GAP_VOXELS: f32 = 1.5;
/// Height over which legs seen below the hem pass into the hidden ones, above and below the hem, metres.
const SEAM_M: f32 = 0.04;
/// Distance beyond the seen legs within which the fused surface is kept, in voxels at the hem, and its fall per metre above it.
const KEPT_VOXELS: f32 = 1.0;
const KEPT_FALL: f32 = 0.4;
/// Height above the hem up to which hidden legs are as much thicker than the body as the seen ones are, falling, and bounds of that, metres.
const SWELL_M: f32 = 0.15;
const SWELLS: std::ops::RangeInclusive<f32> = -0.02..=0.03;
/// Depth below the hem to which the surface that closes it may bulge, metres.
const BULGE_M: f32 = 0.06;
/// Distance of the search for the crotch below the waistband, and its step, metres.
const BELOW_BAND_M: f32 = 0.08;
const CROTCH_STEP_M: f32 = 0.004;
/// Least height of a hollow space, metres: shorter skirts and jackets stay solid.
const LEAST_HEIGHT_M: f32 = 0.06;
/// Reach of the points of the legs, metres.
const SEEN_REACH_M: f32 = 0.1;
/// Cosine below which a surface inside of the skirt does not face outwards with it.
const OUTWARDS: f32 = 0.5;
/// Thickness of the finished wall, metres.
const SHEET_M: f32 = 0.002;

/// Side of a skirt on which a vertex lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    /// Outside, or no part of the skirt: cameras can see it.
    Seen,
    /// Inner side of the skirt.
    Wall,
    /// Legs and hips below the skirt.
    Hidden,
}

/// Empty space between a skirt and the legs below it, in the rest pose.
#[derive(Debug)]
pub(super) struct Hollow {
    /// Skirt with its mean shape: the coarse side of places far from its points.
    tube: SignedSurface,
    /// Points of the skirt.
    sheet: SignedPoints,
    /// Points of the legs that are seen below the hem.
    seen: SignedPoints,
    /// Body without the skirt, its arms left out.
    body: SignedSurface,
    /// Box of the space, metres.
    low: Vec3,
    high: Vec3,
    hem_y: f32,
    voxel_m: f32,
    wall_m: f32,
    /// Median distance of the seen legs just below the hem from the body, metres.
    swell_m: f32,
}

impl Hollow {
    /// Returns whether a dressed body wears a skirt.
    pub fn is_below(dressed: &Template, body: &Template) -> bool {
        skirt_vertices(dressed, body).contains(&true)
    }

    /// Returns the space below the skirt of an avatar; `None` for one without a skirt, or with a short one. `body` is the body that wears
    /// it, valid and with the avatar's skeleton; `points` are those of the avatar's Gaussians, one each.
    pub fn of(avatar: &Avatar, body: &Template, points: &[OrientedPoint], voxel_m: f32) -> Option<Self> {
        let worn = skirt_vertices(&avatar.template, body);
        if !(worn.contains(&true) && voxel_m > 0.0 && voxel_m.is_finite()) {
            return None;
        }
        let surface = avatar.surface();
        let is_worn = |t: &[u32; 3]| t.iter().all(|i| worn[*i as usize]);
        let ys = || avatar.template.positions.iter().zip(&worn).filter(|(_, worn)| **worn).map(|(p, _)| p.y);
        let (least, band_y) = (ys().fold(f32::INFINITY, f32::min), ys().fold(f32::NEG_INFINITY, f32::max));
        let is_hem = |i: usize| worn[i] && avatar.template.positions[i].y < least + 1e-3;
        let hem: Vec<f32> = (0..worn.len()).filter(|i| is_hem(*i)).map(|i| surface.positions[i].y).collect();
        let hem_y = hem.iter().sum::<f32>() / hem.len().max(1) as f32;

        let wall_m = WALL_VOXELS * voxel_m;
        let reach_m = wall_m + (GAP_VOXELS + 2.0) * voxel_m;
        let (mut sheet, mut seen) = (Vec::new(), Vec::new());
        for (point, attachment) in points.iter().zip(&avatar.attachments) {
            let Some(corners) = avatar.template.triangles.get(attachment.triangle as usize) else { continue };
            let Some(normal) = point.normal.try_normalize().filter(|_| point.position.is_finite()) else { continue };
            if is_worn(corners) {
                sheet.push((point.position, normal));
            } else if corners.iter().any(|i| is_leg(avatar.template.parts[*i as usize])) {
                seen.push((point.position, normal));
            }
        }
        let body = SignedSurface::new(body, |t| !t.iter().any(|i| is_arm(body.parts[*i as usize])));
        let places = || surface.positions.iter().zip(&worn).filter(|(_, worn)| **worn).map(|(p, _)| *p);
        let drawn = sheet.iter().map(|(place, _)| *place);
        let (low, high) = (places().fold(Vec3::INFINITY, Vec3::min), places().fold(Vec3::NEG_INFINITY, Vec3::max));
        let (low, high) = drawn.fold((low, high), |(low, high), p| (low.min(p), high.max(p)));
        let centre = places().fold(Vec2::ZERO, |sum, p| sum + Vec2::new(p.x, p.z)) / places().count().max(1) as f32;
        let roof_y = crotch(&body, centre, (hem_y, band_y - BELOW_BAND_M))?;
        let swells = seen.iter().filter(|(place, _)| (hem_y - SEAM_M..hem_y).contains(&place.y));
        let swells: Vec<f32> = swells.filter_map(|(place, _)| Some(body.at(*place)?.distance_m)).collect();
        let swell_m = if swells.is_empty() { 0.0 } else { median(swells).clamp(*SWELLS.start(), *SWELLS.end()) };
        let is_high = roof_y >= hem_y + LEAST_HEIGHT_M && !sheet.is_empty();
        is_high.then(|| Self {
            tube: SignedSurface::new(&surface, is_worn),
            sheet: SignedPoints::new(sheet, reach_m),
            seen: SignedPoints::new(seen, SEEN_REACH_M),
            body,
            low: Vec3::new(low.x, low.y.min(hem_y) - BULGE_M, low.z),
            high: Vec3::new(high.x, roof_y, high.z),
            hem_y,
            voxel_m,
            wall_m,
            swell_m,
        })
    }

    /// Returns whether a place, metres, is empty.
    pub fn is_empty(&self, point: Vec3) -> bool {
        if !(point.cmpge(self.low).all() && point.cmple(self.high).all()) {
            return false;
        }
        let depth_m = self.depth(point).map_or(0.0, |skirt| -skirt.distance_m);
        let above = ((point.y - self.hem_y) / SEAM_M).clamp(0.0, 1.0);
        depth_m > self.wall_m && (depth_m < self.wall_m + above * GAP_VOXELS * self.voxel_m || !self.is_leg(point))
    }

    /// Returns the signed distance from the skirt: negative below it.
    fn depth(&self, point: Vec3) -> Option<Signed> {
        self.sheet.at(point).or_else(|| self.tube.at(point))
    }

    /// Returns whether a place belongs to a leg: the body's above the hem, the fused surface's around points below it.
    fn is_leg(&self, point: Vec3) -> bool {
        let above_m = point.y - self.hem_y;
        let swell_m = self.swell_m * (1.0 - above_m / SWELL_M).clamp(0.0, 1.0);
        if above_m > -SEAM_M && self.body.at(point).is_some_and(|body| body.distance_m < swell_m) {
            return true;
        }
        let kept_m = KEPT_VOXELS * self.voxel_m - KEPT_FALL * above_m.max(0.0);
        above_m < SEAM_M && self.seen.at(point).is_some_and(|leg| leg.distance_m < kept_m)
    }

    /// Returns the side of the skirt on which a vertex with this unit normal lies.
    pub fn side(&self, point: Vec3, normal: Vec3) -> Side {
        let voxel = Vec3::splat(self.voxel_m);
        if !(point.cmpge(self.low - voxel).all() && point.cmple(self.high + voxel).all()) {
            return Side::Seen;
        }
        let Some(skirt) = self.depth(point) else { return Side::Seen };
        let depth_m = -skirt.distance_m;
        let on_leg = |within_m: f32| self.seen.at(point).is_some_and(|leg| leg.distance_m.abs() < within_m);
        if depth_m > self.wall_m + 0.5 * GAP_VOXELS * self.voxel_m {
            let is_hidden = point.y > self.hem_y || !on_leg(KEPT_VOXELS * self.voxel_m);
            return if is_hidden { Side::Hidden } else { Side::Seen };
        }
        let is_inner = depth_m > 2.0 * SHEET_M && normal.dot(skirt.normal) < OUTWARDS;
        if is_inner && !(point.y < self.hem_y && on_leg(0.5 * self.voxel_m)) { Side::Wall } else { Side::Seen }
    }
}

/// Returns which points lie on the strip of the body that a waistband covers; `points` are as of [`Hollow::of`]. The fusion of that strip and
/// of a waistband that hangs in front of it would be a surface between them, with a gap below.
pub(super) fn covered(avatar: &Avatar, body: &Template, points: &[OrientedPoint]) -> Vec<bool> {
    let template = &avatar.template;
    let worn = skirt_vertices(template, body);
    let corners = |attachment: &Attachment| template.triangles.get(attachment.triangle as usize);
    let rows = || points.iter().zip(&avatar.attachments).filter_map(|(point, of)| Some((point, corners(of)?)));
    let of_skirt = rows().filter(|(_, corners)| corners.iter().all(|i| worn[*i as usize]));
    let sheet = of_skirt.filter_map(|(point, _)| Some((point.position, point.normal.try_normalize()?)));
    let sheet = SignedPoints::new(sheet.filter(|(place, _)| place.is_finite()).collect(), BELOW_BAND_M);
    let band_y = (0..worn.len()).filter(|i| worn[*i]).map(|i| template.positions[i].y).fold(f32::MIN, f32::max);
    let is_below = |i: usize| {
        let below_m = band_y - template.positions[i].y;
        !worn[i] && !is_arm(template.parts[i]) && (0.0..BELOW_BAND_M).contains(&below_m)
    };
    let is_covered = |(point, of): (&OrientedPoint, &Attachment)| {
        let is_strip = corners(of).is_some_and(|corners| corners.iter().all(|i| is_below(*i as usize)));
        is_strip && sheet.at(point.position).is_some_and(|skirt| skirt.distance_m < 0.0)
    };
    points.iter().zip(&avatar.attachments).map(is_covered).collect()
}

/// Returns which vertices of a dressed body belong to its skirt: those of the trunk that the body does not have.
fn skirt_vertices(dressed: &Template, body: &Template) -> Vec<bool> {
    let bits = |p: &Vec3| p.to_array().map(f32::to_bits);
    let own: HashSet<[u32; 3]> = body.positions.iter().map(bits).collect();
    let rows = dressed.positions.iter().zip(&dressed.parts);
    rows.map(|(position, part)| *part == Part::Torso && !own.contains(&bits(position))).collect()
}

fn is_leg(part: Part) -> bool {
    matches!(part, Part::LeftLeg | Part::RightLeg | Part::LeftFoot | Part::RightFoot)
}

fn is_arm(part: Part) -> bool {
    matches!(part, Part::LeftArm | Part::RightArm | Part::LeftHand | Part::RightHand)
}

/// Returns the height at which the line down through the middle of a skirt leaves the body, metres; `None` where it does not.
fn crotch(body: &SignedSurface, centre: Vec2, (hem_y, from_y): (f32, f32)) -> Option<f32> {
    let steps = ((from_y - hem_y) / CROTCH_STEP_M).clamp(0.0, 1e4) as usize;
    let heights = (0..=steps).map(|step| from_y - step as f32 * CROTCH_STEP_M);
    heights.into_iter().find(|y| body.at(Vec3::new(centre.x, *y, centre.y)).is_some_and(|body| body.distance_m > 0.0))
}

#[cfg(test)]
mod tests;
