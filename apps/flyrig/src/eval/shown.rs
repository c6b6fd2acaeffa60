//! The reconstruction as people look at it: a page that plays it in 3D, and a film.

use std::{collections::BTreeMap, path::Path};

use anyhow::Result;
use flyrig_fusion::{PersonEncoder, PersonId, Session};
use flyrig_report::write_whole;
use flyrig_stream::ColorSettings;
use flyrig_types::{Camera, FrameSet, Rig};
use flyrig_web::TakePage;

use crate::orbit_film::{Extent, OrbitFilm};

/// Settings of the colours in the page. All of them come with the first frame: no line limits them.
const COLORS: ColorSettings = ColorSettings { step: 6.0, refresh_secs: 1.0, max_frame_bytes: 4 << 20 };

/// Page and film under way.
pub struct TakeShow {
    page: TakePage,
    film: Option<OrbitFilm>,
    /// Hash of the template and encoder of each person.
    encoders: BTreeMap<u32, (u64, PersonEncoder)>,
    /// Time of the first frame set, nanoseconds.
    first_nanos: Option<i64>,
    epoch: u32,
}

impl TakeShow {
    /// Starts a page, and a film if its file is named.
    ///
    /// # Errors
    /// The film's file cannot be created.
    pub fn new(title: &str, rig: &Rig, film: Option<&Path>) -> Result<Self> {
        Ok(Self {
            page: TakePage::new(title, &serde_json::to_vec(rig)?),
            film: film.map(|path| OrbitFilm::create(path, rig)).transpose()?,
            encoders: BTreeMap::new(),
            first_nanos: None,
            epoch: 0,
        })
    }

    /// Adds the people of a frame set.
    ///
    /// # Errors
    /// The adapter fails, or the disk refuses the film.
    pub fn add(&mut self, session: &mut Session, set: &FrameSet) -> Result<()> {
        let nanos = set.master_nanos;
        let seconds = nanos.saturating_sub(*self.first_nanos.get_or_insert(nanos)) as f64 / 1e9;
        let people: Vec<PersonId> = session.subjects().iter().map(flyrig_fusion::Subject::id).collect();
        for id in people {
            let Some(frame) = session.person_frame(id, set)? else { continue };
            let template = frame.template();
            let hash = template.template.hash;
            if self.encoders.get(&id.0).is_none_or(|(known, _)| *known != hash) {
                self.epoch += 1;
                self.page.template(id.0, seconds, &template.bytes);
                self.encoders.insert(id.0, (hash, PersonEncoder::new(&frame, COLORS, self.epoch)));
            }
            let Some((_, encoder)) = self.encoders.get_mut(&id.0) else { continue };
            let messages = encoder.encode(&frame)?;
            self.page.motion(id.0, seconds, &messages.motion);
            for layer in messages.colors.iter().filter(|layer| !layer.is_empty()) {
                self.page.colors(id.0, seconds, layer);
            }
        }
        self.add_to_film(session, nanos)
    }

    fn add_to_film(&mut self, session: &mut Session, nanos: i64) -> Result<()> {
        let Some(film) = &mut self.film else { return Ok(()) };
        let Some((subject, pose)) = session.subjects().iter().find_map(|subject| Some((subject, subject.pose()?)))
        else {
            return Ok(());
        };
        let (positions, _) = subject.surface(pose);
        let Some(extent) = Extent::of(positions.iter().copied(), film.up()) else { return Ok(()) };
        let camera = film.camera(nanos, &extent);
        let view = session.render(&camera)?;
        film.write(&view, &camera, nanos)
    }

    /// Writes the page, and completes the film with the people as they stand.
    ///
    /// # Errors
    /// The disk refuses a file.
    pub fn finish(self, session: &mut Session, page: &Path) -> Result<()> {
        write_whole(page, self.page.html().as_bytes())?;
        self.film.map_or(Ok(()), |film| film.finish(|camera: &Camera| Ok(session.render(camera)?)))
    }
}
