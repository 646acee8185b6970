//! Splats in training, with their optimiser and what density control wants to know of them. Per step an image comes back,
//! and its gradient and one plane of errors go up; the splats do not move.

use crate::GpuError;
use crate::device::{Device, Lent, Work};
use crate::engine::{Binned, Cloud, GROUP, bin};
use crate::passes::Grads;
use crate::shaders::{ADAM, OBSERVE, SHADE, SHADE_BACKWARD, TINT, TINT_BACKWARD};
use crate::view::{pack_image, unpack_image};
use bytemuck::{Pod, Zeroable};
use segwild_raster::{
    Codes, EmbedLook, Frame, FrameGrad, Held, Light, ProjectOptions, RasterError, Resident, Rule, Rules,
    check,
};
use segwild_scene::{Camera, Image, Pose, Splats};
use std::sync::Arc;

/// Splats or their moments.
struct Numbers {
    shapes: Arc<Cloud>,
    /// `[splat][basis function][r, g, b]`.
    sh: Lent,
}

impl Numbers {
    fn upload(work: &mut Work, splats: &Splats) -> Result<Numbers, GpuError> {
        let shapes = Arc::new(Cloud::upload(work, splats)?);
        Ok(Numbers { shapes, sh: work.upload("the splats' harmonics", &splats.sh)? })
    }

    fn read(&self, work: &mut Work, sh_degree: u32) -> Result<Splats, GpuError> {
        let mut splats = Splats { sh_degree, ..Splats::default() };
        self.shapes.read(work, &mut splats)?;
        splats.sh = work.read(&self.sh, self.shapes.splats * splats.sh_stride())?;
        Ok(splats)
    }
}

/// What was drawn last.
struct Drawn {
    on: Binned,
    /// Depth, radius, centre per splat.
    seen: Lent,
    /// The splats' own colours, and those in the photo's light, where there is one.
    colours: Lent,
    lit: Option<Lit>,
    lights: Lent,
    size: [usize; 2],
}

/// Splats in a photo's light.
struct Lit {
    photo: Lent,
    tinted: Lent,
}

/// Codes of splats and their moments.
struct GpuCodes {
    values: Lent,
    first: Lent,
    second: Lent,
}

/// Splats in training on the device.
pub(crate) struct GpuTraining {
    device: Arc<Device>,
    sh_degree: u32,
    splats: Numbers,
    first: Numbers,
    second: Numbers,
    /// For density control: gradient, error, steps, radius.
    sums: Lent,
    codes: Option<GpuCodes>,
    drawn: Option<Drawn>,
}

/// `Rules` of `adam.wgsl`.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct AdamRules {
    first: [f32; 4],
    second: [f32; 4],
    item: [u32; 4],
}

/// Gradients of everything that is trained.
pub(crate) struct StepGrads {
    /// Of [`Grads`].
    shapes: Lent,
    /// As [`Numbers::sh`].
    sh: Lent,
    /// As [`GpuCodes::values`].
    codes: Option<Lent>,
}

/// A group of parameters, as `adam` sees it.
struct Group<'a> {
    /// Its arrays: parameters, first and second moments.
    arrays: [&'a Lent; 3],
    grads: &'a Lent,
    /// Where the gradients of the first item begin, and how far those of the next are.
    from: usize,
    stride: usize,
    /// Numbers of an item; of these, how many are parameters, and how many follow the first of two rules.
    width: usize,
    live: usize,
    split: usize,
    rules: [Rule; 2],
    /// Of splats in sight only, which keep this much of what they come to.
    seen: Option<f32>,
}

impl Group<'_> {
    fn rules(&self) -> AdamRules {
        let rule = |Rule { beta1, beta2, rate, epsilon }: Rule| [beta1, beta2, rate, epsilon];
        AdamRules {
            first: rule(self.rules[0]),
            second: rule(self.rules[1]),
            item: [self.from, self.stride, self.live, self.split].map(|v| v as u32),
        }
    }
}

impl GpuTraining {
    pub fn new(device: &Arc<Device>, held: &Held) -> Result<GpuTraining, GpuError> {
        let mut work = device.work();
        Ok(GpuTraining {
            sh_degree: held.splats.sh_degree,
            splats: Numbers::upload(&mut work, &held.splats)?,
            first: Numbers::upload(&mut work, &held.first)?,
            second: Numbers::upload(&mut work, &held.second)?,
            sums: work.upload("the sums for density control", &held.sums)?,
            codes: match &held.codes.values {
                none if none.is_empty() => None,
                values => Some(GpuCodes {
                    values: work.upload("the splats' codes", values)?,
                    first: work.upload("the codes' first moments", &held.codes.first)?,
                    second: work.upload("the codes' second moments", &held.codes.second)?,
                }),
            },
            drawn: None,
            device: device.clone(),
        })
    }

    fn count(&self) -> usize {
        self.splats.shapes.splats
    }

    /// Numbers of a splat's harmonics.
    fn sh_stride(&self) -> usize {
        3 * (self.sh_degree as usize + 1).pow(2)
    }

    fn try_draw(
        &mut self,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
        light: Option<&Light>,
    ) -> Result<Frame, GpuError> {
        // Its buffers are used again.
        self.drawn = None;
        let n = self.count();
        let mut work = self.device.work();
        let (on, seen) = bin(&mut work, self.splats.shapes.clone(), camera, pose, options)?;
        let colours = work.take::<[f32; 4]>("the splats' colours", n)?;
        let job = [n as u32, self.sh_degree, 0, 0];
        let shapes = &self.splats.shapes;
        work.run(
            &SHADE,
            1,
            job,
            &[&on.view, &shapes.means, &seen, &self.splats.sh, &colours],
            n.div_ceil(GROUP),
        );
        let lit = match light {
            Some(light) => {
                let codes = self.codes.as_ref().expect("light falls on codes");
                let photo = work.upload("the photo's light", light)?;
                let tinted = work.take::<[f32; 4]>("the tinted colours", n)?;
                let buffers = [&photo, &colours, &codes.values, &tinted];
                work.run(&TINT, 1, [n as u32, 0, 0, 0], &buffers, n.div_ceil(GROUP));
                Some(Lit { photo, tinted })
            }
            None => None,
        };
        let alpha = work.take::<f32>("alpha", on.pixels)?;
        let lights = on.lights(&mut work)?;
        let values = lit.as_ref().map_or(&colours, |lit| &lit.tinted);
        let image = on.blend(&mut work, 1, values, true, &alpha, &lights)?;
        let drawn: Vec<f32> = work.read(&image, on.pixels * 4)?;
        let size = [camera.width as usize, camera.height as usize];
        let mut frame =
            Frame { image: Image::zeros(size[0], size[1], 3), alpha: Image::zeros(size[0], size[1], 1) };
        unpack_image(&drawn, 4, 0, &mut frame.image);
        frame.alpha.data.iter_mut().zip(drawn.chunks_exact(4)).for_each(|(to, from)| *to = from[3]);
        drop(work);
        self.drawn = Some(Drawn { on, seen, colours, lit, lights, size });
        Ok(frame)
    }

    fn try_learn(
        &mut self,
        grad: &FrameGrad,
        error: &Image,
        rules: &Rules,
    ) -> Result<Option<Light>, GpuError> {
        let Drawn { on, seen, colours, lit, lights, size } = self.drawn.take().expect("something was drawn");
        let [width, height] = size;
        assert_eq!(
            (grad.image.width, grad.image.height, grad.image.channels),
            (width, height, 3),
            "gradient"
        );
        assert_eq!(error.data.len(), width * height, "error: numbers");
        let n = self.count();
        let work = &mut self.device.work();
        let image = work.upload("the image's gradients", &pack_image(grad.image, 0, 1, grad.alpha))?;
        let error = work.upload("the errors", &error.data)?;
        let by_colour = on.gather(work, 1, &image, &lights)?;
        let values = lit.as_ref().map_or(&colours, |lit| &lit.tinted);
        let grads = on.backward(work, 1, values, &image)?;
        // Where there is light, `by_colour` is of the tinted colours before, and of the splats' own after.
        let by_light = match (&lit, &self.codes) {
            (Some(lit), Some(codes)) => {
                let code_grads = work.take::<[f32; EmbedLook::CODE_SIZE]>("the codes' gradients", n)?;
                let sums = work.take::<Light>("the light's gradients", n.div_ceil(GROUP))?;
                let buffers = [&lit.photo, &colours, &codes.values, &by_colour, &code_grads, &sums];
                work.run(&TINT_BACKWARD, 1, [n as u32, 0, 0, 0], &buffers, n.div_ceil(GROUP));
                Some((code_grads, sums))
            }
            _ => None,
        };
        let sh_grads = work.take::<f32>("the harmonics' gradients", n * self.sh_stride())?;
        let shapes = &self.splats.shapes;
        let buffers = [&on.view, &shapes.means, &seen, &self.splats.sh, &by_colour, &sh_grads, &grads];
        let job = [n as u32, self.sh_degree, 0, 0];
        work.run(&SHADE_BACKWARD, 1, job, &buffers, n.div_ceil(GROUP));
        let buffers = [&on.view, &seen, &grads, &error, &self.sums];
        work.run(&OBSERVE, 1, [n as u32, 0, 0, 0], &buffers, n.div_ceil(GROUP));
        let (codes, by_light) = by_light.unzip();
        self.adam(work, &StepGrads { shapes: grads, sh: sh_grads, codes }, &seen, rules)?;
        work.hand_in();
        let Some(sums) = by_light else { return Ok(None) };
        let sums: Vec<[f32; size_of::<Light>() / 4]> = work.read(&sums, n.div_ceil(GROUP))?;
        Ok(Some(std::array::from_fn(|k| sums.iter().map(|part| f64::from(part[k])).sum::<f64>() as f32)))
    }

    /// The optimiser's step of every group of parameters.
    pub fn adam(
        &self,
        work: &mut Work,
        grads: &StepGrads,
        seen: &Lent,
        rules: &Rules,
    ) -> Result<(), GpuError> {
        let all = [&self.splats, &self.first, &self.second];
        let shape = |of: fn(&Cloud) -> &Lent, from, live, split, rules| Group {
            arrays: all.map(|numbers| of(&numbers.shapes)),
            grads: &grads.shapes,
            from,
            stride: 16,
            width: 4,
            live,
            split,
            rules,
            seen: None,
        };
        let width = self.sh_stride();
        let mut groups = vec![
            shape(|of| &of.means, 0, 4, 3, [rules.means, rules.opacities]),
            shape(|of| &of.log_scales, 4, 3, 3, [rules.log_scales; 2]),
            shape(|of| &of.rotations, 8, 4, 4, [rules.rotations; 2]),
            Group {
                arrays: all.map(|numbers| &numbers.sh),
                grads: &grads.sh,
                from: 0,
                stride: width,
                width,
                live: width,
                split: 3,
                rules: [rules.base, rules.higher],
                seen: None,
            },
        ];
        if let (Some(codes), Some(grads)) = (&self.codes, &grads.codes) {
            let width = EmbedLook::CODE_SIZE;
            groups.push(Group {
                arrays: [&codes.values, &codes.first, &codes.second],
                grads,
                from: 0,
                stride: width,
                width,
                live: width,
                split: width,
                rules: [rules.codes; 2],
                seen: Some(rules.kept),
            });
        }
        // What goes up hands in what stands before it: all at once.
        let rules = groups
            .iter()
            .map(|group| work.upload("the rules", &[group.rules()]))
            .collect::<Result<Vec<_>, _>>()?;
        for (group, rules) in groups.iter().zip(&rules) {
            let numbers = self.count() * group.width;
            let [parameters, first, second] = group.arrays;
            let only_seen = u32::from(group.seen.is_some());
            let job = [numbers as u32, group.width as u32, only_seen, group.seen.unwrap_or(1.0).to_bits()];
            let buffers = [rules, group.grads, parameters, first, second, seen];
            work.run(&ADAM, 1, job, &buffers, numbers.div_ceil(GROUP));
        }
        Ok(())
    }

    /// Gradients of 0.
    pub fn some_gradients(&self) -> Result<StepGrads, GpuError> {
        let mut work = self.device.work();
        let n = self.count();
        let shapes = work.take::<Grads>("the gradients", n)?;
        let sh = work.take::<f32>("the harmonics' gradients", n * self.sh_stride())?;
        work.clear(&shapes);
        work.clear(&sh);
        work.hand_in();
        Ok(StepGrads { shapes, sh, codes: None })
    }

    fn try_fetch(&mut self) -> Result<Held, GpuError> {
        let mut work = self.device.work();
        Ok(Held {
            splats: self.splats.read(&mut work, self.sh_degree)?,
            first: self.first.read(&mut work, self.sh_degree)?,
            second: self.second.read(&mut work, self.sh_degree)?,
            sums: work.read(&self.sums, self.count())?,
            codes: match &self.codes {
                None => Codes::default(),
                Some(codes) => {
                    let numbers = self.count() * EmbedLook::CODE_SIZE;
                    let mut read = |of: &Lent| work.read(of, numbers);
                    Codes {
                        values: read(&codes.values)?,
                        first: read(&codes.first)?,
                        second: read(&codes.second)?,
                    }
                }
            },
        })
    }
}

impl Resident for GpuTraining {
    fn draw(
        &mut self,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
        light: Option<&Light>,
    ) -> Result<Frame, RasterError> {
        check(&Splats::default(), camera)?;
        Ok(self.try_draw(camera, pose, options, light)?)
    }

    fn learn(
        &mut self,
        grad: &FrameGrad,
        error: &Image,
        rules: &Rules,
    ) -> Result<Option<Light>, RasterError> {
        Ok(self.try_learn(grad, error, rules)?)
    }

    fn fetch(&mut self) -> Result<Held, RasterError> {
        Ok(self.try_fetch()?)
    }
}
