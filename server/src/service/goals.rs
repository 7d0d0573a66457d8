//! Goals: images and masks to be reached, fitted to a model once and named afterwards.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use gatsbi_proto::v1::{self, DataType, image::Content};
use parking_lot::{Mutex, RwLock};

use super::{Service, programs};
use crate::{
    access::tenants::Owner,
    engine::models::ModelEntry,
    error::Error,
    planning::cost::Subject,
    sessions::{
        registry::Room,
        session::{bits, shortened},
    },
};

/// Masks by the part of a scene that they are of, each `[H, W]` in [0, 1] with whose it is.
type Masks = BTreeMap<v1::MaskPart, Vec<(Subject, Arc<[f32]>)>>;

/// The goals that are kept.
#[derive(Debug, Default)]
pub(super) struct Kept {
    goals: RwLock<BTreeMap<u128, Arc<Goal>>>,
}

/// A goal.
#[derive(Debug)]
pub(super) struct Goal {
    /// Its id.
    pub(super) id: String,
    /// Hash of the checkpoint that it was prepared for.
    pub(super) model_hash: String,
    /// `[H, W, 3]` in [0, 1].
    pub(super) image: Option<Arc<[f32]>>,
    /// Its masks.
    pub(super) masks: Masks,
    owner: Owner,
    ttl: Duration,
    used: Mutex<Instant>,
    _room: Room,
}

impl Goal {
    fn expires(&self) -> Instant {
        *self.used.lock() + self.ttl
    }
}

impl Kept {
    pub(super) fn sweep(&self, now: Instant) {
        self.goals.write().retain(|_, goal| goal.expires() > now);
    }
}

impl Service {
    /// Keeps a goal.
    ///
    /// # Errors
    /// If the request is wrong, or too much is kept already.
    pub async fn put_goal(
        &self,
        request: v1::PutGoalRequest,
    ) -> Result<v1::PutGoalResponse, Error> {
        let model = self.catalogue.get(&request.model)?;
        let ttl = self.ttl(request.ttl)?;
        if request.image.is_none() && request.masks.is_empty() {
            return Err(Error::invalid("image", "absent", "an image, masks, or both"));
        }
        let image = match request.image {
            Some(image) => {
                Some(colours_last(&self.fit(image, "image", &model).await?.frame.floats()))
            }
            None => None,
        };
        let mut masks = Masks::new();
        for (at, asked) in request.masks.into_iter().enumerate() {
            let field = format!("masks[{at}]");
            let part = programs::part(asked.part, &format!("{field}.part"))?;
            let prepared = self.masks(asked, part, &field, &model).await?;
            if masks.insert(part, prepared).is_some() {
                let found = part.as_str_name();
                return Err(Error::invalid(format!("{field}.part"), found, "each part once"));
            }
        }
        let pixels = (model.spec.image_size * model.spec.image_size) as u64;
        let pictures = masks.values().map(|masks| masks.len() as u64).sum::<u64>()
            + image.as_ref().map_or(0, |_| 3);
        let room = self.registry.reserve(pictures * pixels * 4, &self.owner)?;
        let number = rand::random::<u128>();
        let id = format!("{number:032x}");
        let goal = v1::Goal {
            id: id.clone(),
            label: request.label,
            model: model.spec.name.clone(),
            has_image: image.is_some(),
            parts: masks.keys().map(|part| *part as i32).collect(),
            expires_at: Some((SystemTime::now() + ttl).into()),
        };
        let used = Mutex::new(Instant::now());
        let model_hash = model.spec.hash.clone();
        let owner = self.owner.clone();
        let kept = Goal { id, model_hash, image, masks, owner, ttl, used, _room: room };
        self.goals.goals.write().insert(number, Arc::new(kept));
        Ok(v1::PutGoalResponse { goal: Some(goal) })
    }

    /// Forgets a goal; plans that use it go on.
    ///
    /// # Errors
    /// If there is none.
    pub fn delete_goal(
        &self,
        request: &v1::DeleteGoalRequest,
    ) -> Result<v1::DeleteGoalResponse, Error> {
        let goal = self.goal(&request.goal_id)?;
        self.goals.goals.write().retain(|_, kept| !Arc::ptr_eq(kept, &goal));
        Ok(v1::DeleteGoalResponse {})
    }

    /// A goal, which counts as used.
    pub(super) fn goal(&self, id: &str) -> Result<Arc<Goal>, Error> {
        let now = Instant::now();
        let goal = bits(id).and_then(|bits| self.goals.goals.read().get(&bits).cloned());
        let goal = goal.filter(|goal| goal.expires() > now && self.owner.sees(&goal.owner));
        let goal = goal.ok_or_else(|| Error::UnknownGoal { id: shortened(id) })?;
        *goal.used.lock() = now;
        Ok(goal)
    }

    /// Masks of one part, fitted.
    async fn masks(
        &self,
        asked: v1::MaskGoal,
        part: v1::MaskPart,
        field: &str,
        model: &Arc<ModelEntry>,
    ) -> Result<Vec<(Subject, Arc<[f32]>)>, Error> {
        let (ids_field, field) = (format!("{field}.object_ids"), format!("{field}.masks"));
        let tensor = asked.masks.unwrap_or_default();
        let each = part == v1::MaskPart::EachObject;
        let (count, size) = match *tensor.shape.as_slice() {
            [count, height, width] if each && count > 0 => (count as usize, [height, width]),
            [height, width] if !each => (1, [height, width]),
            _ => {
                let expected = if each { "[objects, height, width]" } else { "[height, width]" };
                let found = format!("{:?}", tensor.shape);
                return Err(Error::invalid(format!("{field}.shape"), found, expected));
            }
        };
        let subjects: Vec<Subject> = match part {
            v1::MaskPart::EachObject => {
                let ids = asked.object_ids.iter().map(|id| i64::try_from(*id));
                let ids: Result<Vec<i64>, _> = ids.collect();
                let ids = ids.ok().filter(|ids| ids.len() == count);
                let found = || format!("{:?}", asked.object_ids);
                ids.ok_or_else(|| {
                    Error::invalid(ids_field, found(), format!("the ids of {count} objects"))
                })?
                .into_iter()
                .map(Subject::Object)
                .collect()
            }
            v1::MaskPart::Agent if model.spec.agent_slot.is_none() => {
                return Err(Error::invalid(field, "the agent", "objects: the model has no agent"));
            }
            v1::MaskPart::Agent => vec![Subject::Agent],
            _ => vec![Subject::AllObjects],
        };
        let most = model.spec.max_objects as usize;
        if count > most {
            let expected = format!("at most {most} objects");
            return Err(Error::invalid(format!("{field}.shape"), count, expected));
        }
        let width = match tensor.dtype() {
            DataType::U8 => 1,
            _ => 4,
        };
        let data = match tensor.dtype() {
            DataType::U8 => crate::tensor::bytes(&tensor, &field)?.to_vec(),
            _ => crate::tensor::floats(&tensor, &field)?
                .iter()
                .flat_map(|x| x.to_le_bytes())
                .collect(),
        };
        let mut masks = Vec::new();
        let bytes = size.iter().map(|side| *side as usize).product::<usize>() * width;
        for (at, subject) in subjects.into_iter().enumerate() {
            // As a grey image, so that masks are fitted as frames are.
            let grey = data[at * bytes..][..bytes].chunks_exact(width);
            let colours = grey.flat_map(|value| [value, value, value]).flatten().copied();
            let pixels = v1::Tensor {
                dtype: tensor.dtype,
                shape: vec![size[0], size[1], 3],
                data: colours.collect::<Vec<u8>>().into(),
                values: Vec::new(),
            };
            let image = v1::Image { content: Some(Content::Pixels(pixels)) };
            let fitted = self.fit(image, &field, model).await?.frame.floats();
            masks.push((subject, fitted[..fitted.len() / 3].into()));
        }
        Ok(masks)
    }
}

/// `[3, H, W]` as `[H, W, 3]`.
fn colours_last(pixels: &[f32]) -> Arc<[f32]> {
    let area = pixels.len() / 3;
    (0..area).flat_map(|at| [0, 1, 2].map(|colour| pixels[colour * area + at])).collect()
}
