//! Points on which the depths of several photos agree.

use crate::frame::StereoFrame;
use crate::plane::SourceView;
use crate::sweep::Depths;
use glam::{Vec2, Vec3};
use segwild_scene::{Observation, Point, Random, Scene};
use std::collections::BTreeMap;

/// Least matching score of a plane whose depth is used.
const LEAST_ALIKE: f32 = 0.8;
/// How far two photos' depths may lie apart, as a share.
const APART: f32 = 0.01;
/// Largest reprojection error of a pixel that is projected to another photo by one depth and back by the other's, in pixels.
const ASTRAY: f32 = 1.0;
/// Other photos that must agree, where so many are compared.
const OTHERS: usize = 2;
/// Cells, along a photo's long side, over which points are spread.
const CELLS: f32 = 40.0;

pub(crate) fn points(
    scene: &Scene,
    frames: &[StereoFrame],
    sources: &[Vec<usize>],
    depths: &[Depths],
    most: usize,
    seed: u64,
) -> Vec<Point> {
    let mut taken: Vec<Vec<bool>> =
        frames.iter().map(|f| vec![false; f.coarse.width * f.coarse.height]).collect();
    let mut found = Vec::new();
    for (k, frame) in frames.iter().enumerate() {
        let links: Vec<(usize, SourceView, SourceView)> = sources[k]
            .iter()
            .map(|&j| {
                let (here, there) = ((&frame.fine, &frame.pose), (&frames[j].fine, &frames[j].pose));
                (j, SourceView::new(here, there), SourceView::new(there, here))
            })
            .collect();
        let wanted = OTHERS.min(links.len());
        if wanted == 0 {
            continue;
        }
        let (w, h) = (frame.coarse.width, frame.coarse.height);
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            let i = y * w + x;
            if taken[k][i] || depths[k].scores[i] < LEAST_ALIKE {
                continue;
            }
            let at = middle(x, y);
            let near = depths[k].planes[i].near;
            let mut seen = vec![(k, i, at, near)];
            for (j, there, back) in &links {
                let Some((u, v, expected)) = there.project(at.x, at.y, near) else { continue };
                let (ow, oh) = (frames[*j].coarse.width, frames[*j].coarse.height);
                if !(u >= 0.0 && v >= 0.0 && u < (2 * ow) as f32 && v < (2 * oh) as f32) {
                    continue;
                }
                let (ox, oy) = (u as usize / 2, v as usize / 2);
                let o = oy * ow + ox;
                if depths[*j].scores[o] < LEAST_ALIKE {
                    continue;
                }
                let off = Vec2::new(u, v) - middle(ox, oy);
                let own = depths[*j].planes[o].at(off.x, off.y).near;
                if (own - expected).abs() > APART * expected {
                    continue;
                }
                let Some((bx, by, _)) = back.project(u, v, own) else { continue };
                if Vec2::new(bx, by).distance(at) <= ASTRAY {
                    seen.push((*j, o, Vec2::new(u, v), own));
                }
            }
            if seen.len() <= wanted {
                continue;
            }
            let (mut position, mut colour) = (Vec3::ZERO, [0.0f32; 3]);
            for &(j, o, pixel, near) in &seen {
                let f = &frames[j];
                taken[j][o] = true;
                let there = f.fine.camera.ray(pixel) / near;
                position += f.pose.rotation.transpose() * (there - f.pose.translation);
                for (c, sum) in colour.iter_mut().enumerate() {
                    *sum += f.image.at(c, pixel.x as usize, pixel.y as usize);
                }
            }
            let share = 1.0 / seen.len() as f32;
            let mut track: Vec<Observation> = seen
                .iter()
                .map(|&(j, _, pixel, _)| {
                    let (small, full) = (frames[j].fine.camera, scene.views[frames[j].view].camera);
                    let scale = Vec2::new(
                        full.width as f32 / small.width as f32,
                        full.height as f32 / small.height as f32,
                    );
                    Observation { view: frames[j].view as u32, pixel: (pixel * scale).into() }
                })
                .collect();
            track.sort_by_key(|o| o.view);
            found.push(Point { position: position * share, colour: colour.map(|c| c * share), track });
        }
    }
    spread(&mut found, scene, most, seed);
    found
}

/// Leaves `most` points, so that every part of every photo has some before any has many.
fn spread(found: &mut Vec<Point>, scene: &Scene, most: usize, seed: u64) {
    if found.len() <= most {
        return;
    }
    let mut order: Vec<usize> = (0..found.len()).collect();
    Random::stream(seed, 0xa62ee).shuffle(&mut order);
    // The lowest rank of a point among those of its cells: the photos that show it best need it most.
    let mut counts: BTreeMap<(u32, u32, u32), u32> = BTreeMap::new();
    for point in &scene.points {
        for o in &point.track {
            *counts.entry(cell(scene, o)).or_default() += 1;
        }
    }
    let mut ranks: Vec<(u32, usize)> = order
        .iter()
        .map(|&i| {
            let mut rank = u32::MAX;
            for o in &found[i].track {
                let count = counts.entry(cell(scene, o)).or_default();
                rank = rank.min(*count);
                *count += 1;
            }
            (rank, i)
        })
        .collect();
    ranks.sort_by_key(|r| r.0);
    ranks.truncate(most);
    let mut kept: Vec<usize> = ranks.into_iter().map(|r| r.1).collect();
    kept.sort_unstable();
    *found = kept.into_iter().map(|i| found[i].clone()).collect();
}

/// Centre of the pixel of an entry.
fn middle(x: usize, y: usize) -> Vec2 {
    let (x, y) = Depths::pixel(x, y);
    Vec2::new(x as f32 + 0.5, y as f32 + 0.5)
}

fn cell(scene: &Scene, o: &Observation) -> (u32, u32, u32) {
    let camera = scene.views[o.view as usize].camera;
    let side = camera.width.max(camera.height) as f32 / CELLS;
    (o.view, (o.pixel[0] / side) as u32, (o.pixel[1] / side) as u32)
}
